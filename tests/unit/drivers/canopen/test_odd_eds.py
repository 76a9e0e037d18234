"""EDS files that name another drive or are wrong: tolerated with a remark, or refused where it matters."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path
from typing import Any

import pytest

from jointctl.drivers.canopen.settings import CanopenSettings
from jointctl.drivers.drive import CommissioningReport
from jointctl.drivers.errors import DeviceError
from tests.unit.drivers.canopen.odd_drive import opened

pytestmark = pytest.mark.usefixtures("short_timeout")

# --- identity --------------------------------------------------------------------------------------------------


def test_an_eds_that_does_not_name_its_maker(commission: Any, device_on_bus: Any) -> None:
    device_on_bus.answers[(0x1018, 1)] = 0x9A  # the shipped EDS says vendor 0
    assert not any("vendor" in remark for remark in commission().remarks)


@pytest.mark.parametrize(("named", "accepted"), [(None, False), (0x9A, True), (0x9B, False)])
def test_an_eds_of_another_maker(
    device_on_bus: Any, settings_of_virtual_joint: CanopenSettings, tmp_path: Path, named: int | None, accepted: bool
) -> None:
    device_on_bus.answers[(0x1018, 1)] = 0x9A
    path = tmp_path / "other.eds"
    text = settings_of_virtual_joint.eds_path.read_text()
    path.write_text(text.replace("VendorNumber=0", "VendorNumber=0x2E1"))
    settings = dataclasses.replace(settings_of_virtual_joint, eds_path=path, vendor_id=named)
    with opened(device_on_bus, settings) as drive:
        if accepted:
            assert "EDS other.eds is of vendor 0x2e1, node 1 is of vendor 0x9a" in drive.commission().remarks
            return
        words = "other.eds is of vendor 0x2e1" if named is None else "drive.vendor_id is 0x9a, the configuration says"
        with pytest.raises(DeviceError, match=words):
            drive.commission()


def test_an_eds_of_another_product_is_told(commission: Any, device_on_bus: Any) -> None:
    device_on_bus.answers[(0x1018, 2)] = 0x77
    assert "EDS edited.eds is of product 0x1, node 1 is product 0x77" in commission().remarks


# --- EDS files that are wrong where it matters, and elsewhere ---------------------------------------------------


def commissioned_with(bus: Any, settings: CanopenSettings, path: Path, text: str) -> CommissioningReport:
    path.write_text(text, encoding="latin-1")
    with opened(bus, dataclasses.replace(settings, eds_path=path)) as drive:
        return drive.commission()


def test_a_sloppy_eds_is_used_and_its_defects_are_told(
    device_on_bus: Any, settings_of_virtual_joint: CanopenSettings, tmp_path: Path
) -> None:
    text = settings_of_virtual_joint.eds_path.read_text()
    text = text.replace("[6041]\n", "[6041]\nDescription=gerätespezifisch\n").replace("[1000]", "junk\n[1000]")
    text = re.sub(r"(?s)(\[6064\].*?)DataType=0x0004\n", r"\1", text, count=1)
    report = commissioned_with(device_on_bus, settings_of_virtual_joint, tmp_path / "sloppy.eds", text)
    told = [remark for remark in report.remarks if remark.startswith("EDS sloppy.eds: ")]
    assert len(told) == 3
    assert "[6064] has no DataType: INTEGER32 of the standard is used" in told[2]


def test_an_eds_that_is_wrong_about_a_cyclic_object_is_refused(
    device_on_bus: Any, settings_of_virtual_joint: CanopenSettings, tmp_path: Path
) -> None:
    text = settings_of_virtual_joint.eds_path.read_text()
    text = re.sub(r"(?s)(\[6071\].*?)DataType=0x0003\n", r"\1DataType=0x0004\n", text, count=1)
    message = r"object 6071 \(target torque\) DataType \(=INTEGER32\) must be INTEGER16, and jointctl needs it"
    with pytest.raises(DeviceError, match=message):
        commissioned_with(device_on_bus, settings_of_virtual_joint, tmp_path / "wrong.eds", text)


def test_a_value_that_does_not_fit_the_type_of_the_eds_is_one_line(
    device_on_bus: Any, settings_of_virtual_joint: CanopenSettings, tmp_path: Path
) -> None:
    text = settings_of_virtual_joint.eds_path.read_text()
    text = re.sub(r"(?s)(\[6072\].*?)DataType=0x0006\n", r"\1DataType=0x0005\n", text, count=1)
    with pytest.raises(DeviceError, match=r"6072 \(max torque\) has 8 bits, which do not hold 1000"):
        commissioned_with(device_on_bus, settings_of_virtual_joint, tmp_path / "short.eds", text)
