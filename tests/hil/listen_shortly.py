"""`jointctl WORDS` that listens to a bus for a moment before it sends anything, where a user's listens for a second.

That it listens, and for how long, is in tests/unit/drivers/canopen; a run of another test waits for nothing that it
could hear there.  Nothing is imported earlier than a user's program imports it.
"""

from __future__ import annotations

import importlib.abc
import importlib.util
import runpy
import sys
from importlib.machinery import ModuleSpec
from types import ModuleType

LISTENER, LISTEN_S = "jointctl.drivers.canopen.network", 0.2


class Shortly(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Finds the module that listens, and changes it as soon as it is loaded."""

    def find_spec(self, name: str, path: object, target: ModuleType | None = None) -> ModuleSpec | None:
        if name != LISTENER:
            return None
        sys.meta_path.remove(self)
        self._spec = importlib.util.find_spec(name)
        assert self._spec is not None
        return importlib.util.spec_from_file_location(name, self._spec.origin, loader=self)

    def exec_module(self, module: ModuleType) -> None:
        assert self._spec is not None
        assert self._spec.loader is not None
        self._spec.loader.exec_module(module)
        module.LISTEN_S = LISTEN_S  # type: ignore[attr-defined]


if __name__ == "__main__":
    sys.meta_path.insert(0, Shortly())
    runpy.run_module("jointctl.tools.verbs", run_name="__main__", alter_sys=True)
