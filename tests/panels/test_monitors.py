"""Panels are bound to monitors by EDID serial, then connector, then explicit index; never by a guess."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from runtime.config import PanelSettings
from runtime.errors import InputError, PanelLost
from runtime.panels.monitors import Monitor, bind, check_shape


def monitor(connector: str, serial: str = "", x_px: int = 0) -> Monitor:
    return Monitor(connector, serial, "EIZ", x_px, 0, 1920, 1080, 60.0)


LEFT, MIDDLE, RIGHT = monitor("DP-1", "A", 0), monitor("DP-2", "B", 1920), monitor("HDMI-1", "C", 3840)


@given(st.permutations([LEFT, MIDDLE, RIGHT]))
def test_a_serial_finds_its_monitor_wherever_it_is_plugged_in(there: Any) -> None:
    panels = [PanelSettings(edid_serial=serial) for serial in "CAB"]
    assert bind(panels, there) == (RIGHT, LEFT, MIDDLE)


def test_a_connector_serves_where_no_serial_is_named() -> None:
    assert bind([PanelSettings(connector="DP-2")], [LEFT, MIDDLE]) == (MIDDLE,)


def test_an_index_counts_from_the_left() -> None:
    assert bind([PanelSettings(index=2), PanelSettings(index=0)], [RIGHT, LEFT, MIDDLE]) == (RIGHT, LEFT)


def test_a_missing_serial_is_not_made_up_for_by_its_connector() -> None:
    with pytest.raises(PanelLost, match=r"panel 0: no monitor with EDID serial Z and connector DP-1 .*DP-1"):
        bind([PanelSettings(edid_serial="Z", connector="DP-1")], [LEFT])


def test_two_monitors_of_one_serial_are_told_apart_by_connector_only() -> None:
    twins = [monitor("DP-1", "A"), monitor("DP-2", "A", 1920)]
    with pytest.raises(PanelLost, match="panel 0: 2 monitors with EDID serial A"):
        bind([PanelSettings(edid_serial="A")], twins)
    assert bind([PanelSettings(edid_serial="A", connector="DP-2")], twins) == (twins[1],)


def test_two_panels_on_one_monitor_are_refused() -> None:
    with pytest.raises(PanelLost, match="panels 0 and 1"):
        bind([PanelSettings(edid_serial="A"), PanelSettings(connector="DP-1")], [LEFT, MIDDLE])


def test_a_panel_that_names_nothing_is_a_mistake_that_no_waiting_mends() -> None:
    with pytest.raises(InputError, match=r"output: panels\.0"):
        bind([PanelSettings()], [LEFT])


def test_a_mode_of_another_shape_is_refused_and_a_smaller_one_of_the_same_is_not() -> None:
    check_shape(0, PanelSettings(), LEFT, width_px=960, height_px=540)
    with pytest.raises(PanelLost, match="panel 1: DP-1 shows 1080x1920"):
        check_shape(1, PanelSettings(rotation_deg=90), LEFT, width_px=1920, height_px=1080)
