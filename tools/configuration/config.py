"""A configuration as one frozen object: its sections, and the files beside it that it names.

It is read and checked by `load.load_config`.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

from pydantic import AfterValidator, Field, PrivateAttr

from jointctl.drivers.errors import ConfigurationError
from jointctl.tools.configuration.bus_options import whole_channel
from jointctl.tools.configuration.elmo import ElmoSerial
from jointctl.tools.configuration.joint_encoder import JointEncoder
from jointctl.tools.configuration.plant import Virtual
from jointctl.tools.configuration.sections import (
    Bus,
    Control,
    Drive,
    Encoder,
    Friction,
    Joint,
    Limits,
    Live,
    Log,
    Loop,
    Margin,
    Section,
    Sequence,
)
from jointctl.tools.configuration.trajectory import Trajectory

SHIPPED_FOLDER = Path(__file__).resolve().parents[2] / "configs"


class Config(Section):
    """One joint, its drive and what it shall do; [virtual] only matters on the virtual bus."""

    bus: Annotated[Bus, AfterValidator(whole_channel)]
    drive: Annotated[Drive | ElmoSerial, Field(discriminator="kind")]
    encoder: Encoder
    joint: Joint
    joint_encoder: JointEncoder | None = None
    limits: Limits
    sequence: Sequence
    loop: Loop
    control: Control
    trajectory: Trajectory
    friction: Friction | None = None
    virtual: Virtual | None = None
    margin: Margin = Margin()
    live: Live = Live()
    log: Log = Log()

    _path: Path = PrivateAttr(default=Path())
    _text: str = PrivateAttr(default="")

    @property
    def path(self) -> Path:
        """The file that this was read from."""
        return self._path

    @property
    def text(self) -> str:
        """The file as it was read, for the log."""
        return self._text

    @property
    def canopen(self) -> Drive:
        """[drive] of a CANopen drive; `ConfigurationError` for any other."""
        if not isinstance(self.drive, Drive):
            raise ConfigurationError(f'{self._path}: drive.kind (={self.drive.kind}) must be "canopen" here')
        return self.drive

    @property
    def is_serial(self) -> bool:
        """Whether the drive is on a serial line: its statuswords are not those of CiA 402, it heeds no heartbeat."""
        return isinstance(self.drive, ElmoSerial)

    @property
    def eds_path(self) -> Path:
        """The EDS file: beside the configuration, else a shipped one."""
        return _beside(self._path, self.canopen.eds)

    @property
    def encoder_eds_path(self) -> Path | None:
        """The EDS file of the joint's encoder node."""
        encoder = self.joint_encoder
        return _beside(self._path, encoder.eds) if encoder is not None and encoder.source == "node" else None

    @property
    def table_path(self) -> Path | None:
        """The file of a table trajectory."""
        return _beside(self._path, self.trajectory.file) if self.trajectory.kind == "table" else None


def _beside(config_path: Path, name: str) -> Path:
    own = config_path.parent / name
    shipped = SHIPPED_FOLDER / name
    return shipped if not os.path.exists(own) and os.path.exists(shipped) else own
