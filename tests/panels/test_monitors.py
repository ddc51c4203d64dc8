"""Panels are bound to monitors by EDID serial, then connector; never by a guess. A monitor must
show the stack's own pixels, and all panels at one rate: else phases are rescaled, or frames torn."""

from __future__ import annotations

import tomllib
from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from runtime.config import PanelSettings
from runtime.errors import InputError, PanelLost
from runtime.panels.monitors import Monitor, bind, check_modes, gamma_warning, in_order, refresh_difference
from runtime.panels.xlib import Mode, refresh_rate_hz


def monitor(connector: str, serial: str = "", x_px: int = 0) -> Monitor:
    return Monitor(connector, serial, "EIZ", x_px, 0, 1920, 1080, 60.0)


LEFT, MIDDLE, RIGHT = monitor("DP-1", "A", 0), monitor("DP-2", "B", 1920), monitor("HDMI-1", "C", 3840)


@given(st.permutations([LEFT, MIDDLE, RIGHT]))
def test_a_serial_finds_its_monitor_wherever_it_is_plugged_in(there: Any) -> None:
    panels = [PanelSettings(edid_serial=serial) for serial in "CAB"]
    assert bind(panels, there) == (RIGHT, LEFT, MIDDLE)


def test_a_connector_serves_where_a_serial_names_none_or_two() -> None:
    assert bind([PanelSettings(connector="DP-2")], [LEFT, MIDDLE]) == (MIDDLE,)
    twins = [monitor("DP-1", "A"), monitor("DP-2", "A", 1920)]
    assert bind([PanelSettings(edid_serial="A", connector="DP-2")], twins) == (twins[1],)


def test_the_line_that_selects_a_monitor_selects_it_among_all() -> None:
    twins = [monitor("DP-1", "0000000000000"), monitor("DP-2", "0000000000000", 1920), monitor("DP-3", 'a"\\', 3840)]
    for each in twins:
        settings = PanelSettings.model_validate(tomllib.loads(each.setting(twins)))
        assert bind([settings], twins) == (each,)


NONE = "panel 0: no monitor has EDID serial Z and connector DP-1; .*DP-1"


@pytest.mark.parametrize(
    ("panels", "error", "told"),
    [
        ([{"edid_serial": "Z", "connector": "DP-1"}], PanelLost, NONE),
        ([{"edid_serial": "A"}], PanelLost, "panel 0: 2 monitors have EDID serial A"),
        ([{"edid_serial": "B"}, {"connector": "DP-2"}], PanelLost, "panels 0 and 1"),
        ([{}], InputError, r"output: panels\.0"),  # which no waiting mends
    ],
)
def test_panels_that_do_not_select_one_free_monitor_are_refused(panels: Any, error: type[Exception], told: str) -> None:
    with pytest.raises(error, match=told):
        bind([PanelSettings(**panel) for panel in panels], [LEFT, MIDDLE, replace(RIGHT, serial="A")])


FULL = Monitor("DP-1", "A", "EIZ", 0, 0, 1920, 1080, 60.0)


def check(panel: PanelSettings, monitor: Monitor) -> None:
    """Bind as the second panel of a stack of 1920x1080."""
    panels, monitors = (PanelSettings(), panel), (FULL, monitor)
    check_modes(panels, monitors, width_px=1920, height_px=1080)


def test_modes_of_other_pixels_are_refused_and_rotated_panels_compared_as_seen() -> None:
    small, upright = replace(FULL, width_px=1280, height_px=720), replace(FULL, width_px=1080, height_px=1920)
    check(PanelSettings(), FULL)
    check(PanelSettings(rotation_deg=90), upright)
    with pytest.raises(
        PanelLost, match=r"panel 1: DP-1 shows 1280x720 .*the stack has 1920x1080 pixels; change the mode"
    ):
        check(PanelSettings(), small)
    with pytest.raises(PanelLost, match="panel 1: DP-1 shows 1080x1920"):
        check(PanelSettings(), upright)


def test_drifting_rates_are_reported_and_unknown_ones_not_guessed() -> None:
    assert refresh_difference([FULL, replace(FULL, connector="DP-2", refresh_hz=59.98)]) == ""
    assert refresh_difference([FULL, replace(FULL, refresh_hz=0.0)]) == refresh_difference([]) == ""
    assert refresh_difference([replace(FULL, refresh_hz=0.1), replace(FULL, refresh_hz=0.05)]) == ""  # just tolerated
    told = refresh_difference([FULL, replace(FULL, connector="DP-2", refresh_hz=59.94)])
    assert "DP-1 60.00 Hz, DP-2 59.94 Hz" in told


@pytest.mark.parametrize("place", [(0, 0), (1919, 0), (0, 1079)])
def test_panels_on_mirrored_or_overlapping_monitors_are_refused(place: tuple[int, int]) -> None:
    first = Monitor("DP-1", "", "", 0, 0, 1920, 1080, 60.0)
    second = Monitor("DP-2", "", "", *place, 1920, 1080, 60.0)
    panels = [PanelSettings(connector="DP-1"), PanelSettings(connector="DP-2")]
    with pytest.raises(PanelLost, match=r"panels 0 and 1 would show the same pixels.*xrandr --output DP-2"):
        bind(panels, [first, second])
    for beside in ((1920, 0), (-1920, 0), (0, 1080), (0, -1080)):
        apart = replace(second, x_px=beside[0], y_px=beside[1])
        bind(panels, [first, apart])
        assert in_order([first, apart]) == ((first, apart) if beside > (0, 0) else (apart, first))


def test_a_changed_gamma_is_told_with_the_way_back() -> None:
    monitors = [Monitor(f"DP-{n}", "", "", 1920 * n, 0, 1920, 1080, 60.0, has_gamma=n == 1) for n in range(3)]
    assert gamma_warning(monitors[:1]) == gamma_warning([FULL]) == ""
    assert "grey levels of DP-1" in gamma_warning(monitors) and "--output DP-1 --gamma 1:1:1" in gamma_warning(monitors)


@pytest.mark.parametrize(
    ("dot_clock", "h_total", "v_total", "flags", "expected_hz"),
    [
        (148_500_000, 2200, 1125, 0x5, 60.0),
        (74_250_000, 2200, 1125, 0x15, 60.0),  # interlaced: two fields for a picture
        (12_576_000, 800, 131, 0x25, 60.0),  # each line twice
        (148_500_000, 0, 1125, 0, 0.0),
        (148_500_000, 2200, 0, 0, 0.0),
    ],
)
def test_a_mode_s_rate_follows_from_its_clock_and_lines(
    dot_clock: int, h_total: int, v_total: int, flags: int, expected_hz: float
) -> None:
    mode = Mode(dot_clock=dot_clock, h_total=h_total, v_total=v_total, flags=flags)
    assert refresh_rate_hz(mode) == pytest.approx(expected_hz)
