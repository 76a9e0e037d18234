"""What a verb did not foresee: one line on stderr and code 1, as for every other error.

By then the verb has been left: a drive that it had under power has been switched off on the way.
"""

from __future__ import annotations

import errno
import os
import sys
from typing import NoReturn

from jointctl.drivers.errors import JointctlError
from jointctl.drivers.printable import one_line
from jointctl.tools.output import Output

TRACEBACK = "JOINTCTL_TRACEBACK"  # in the environment: show where an unexpected error comes from


def end_unexpected(error: Exception) -> NoReturn:
    """Ends the program; re-raises with `TRACEBACK` set."""
    if os.environ.get(TRACEBACK):
        raise error
    if isinstance(error, OSError) and error.errno in (errno.EMFILE, errno.ENFILE):
        Output().error(f"open files: {error.strerror}", "raise the limit, such as `ulimit -n 1024`")
    elif isinstance(error, MemoryError):
        Output().error("there is too little memory for this", "end other programs, or give it less to do")
    else:
        Output().error(
            one_line(f"a fault of jointctl itself: {type(error).__name__}: {error}"),
            f"{TRACEBACK}=1 in the environment shows where; please report it",
        )
    sys.exit(JointctlError.exit_code)
