"""Verniers on the panels, and the hand that nudges them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from calib.keys import Key
from calib.panel_run import nudge
from calib.registration import Setting
from calib.vernier import ARM_PX, STEPS_PX, Nudging, chart, draw, nominal, read_settings, resumed, write_settings
from runtime.errors import InputError
from runtime.optics.retina import seen_by
from runtime.optics.stack import PanelStack

STACK = PanelStack(0.5184, 0.2916, (-0.06, 0.0, 0.06), 960, 540)
EYE = (0.5, 0.0, 0.0)


def test_every_panel_is_set_against_the_reference_at_places_that_show_on_both() -> None:
    asked = nominal(EYE, STACK, reference=1)
    assert {s.panel for s in asked} == {0, 2}
    assert len(asked) == 30
    for s in asked:
        for u, v in (s.reference_px, s.panel_px):
            assert ARM_PX <= u <= 960 - ARM_PX
            assert ARM_PX <= v <= 540 - ARM_PX


def test_on_a_perfect_stack_the_halves_meet_for_the_eye() -> None:
    """The eye's view of one vernier against a cross drawn whole on the reference panel."""
    one = nominal(EYE, STACK, reference=1)[0]
    view = {"fov_deg": 60.0, "width_px": 960, "height_px": 540}
    whole = np.zeros((3, 540, 960, 4), np.uint8)
    for half in (True, False):
        draw(whole, index=1, at_px=one.reference_px, first_half=half)
    places = [
        np.argwhere(seen_by(EYE, layers, STACK, **view).image[..., 0] > 0.5).mean(0)
        for layers in (chart(STACK, [one]), whole)
    ]
    # The rear panel's arms look a little shorter, which moves the mean along them; the meeting point stays.
    np.testing.assert_allclose(places[0], places[1], atol=3)
    crossing = seen_by(EYE, chart(STACK, [one]), STACK, **view).image[..., 0]
    rows, columns = np.flatnonzero(crossing.sum(0) > 8), np.flatnonzero(crossing.sum(1) > 8)
    assert np.ptp(rows) <= 4
    assert np.ptp(columns) <= 4


def test_a_tenth_of_a_pixel_is_drawn() -> None:
    def mean_u(at: float) -> float:
        layers = np.zeros((1, 200, 200, 4), np.uint8)
        draw(layers, index=0, at_px=(at, 100.0), first_half=True)
        upper = layers[0, :95, :, 0].astype(float)
        return float((upper * (np.arange(200) + 0.5)).sum() / upper.sum())

    assert mean_u(100.3) - mean_u(100.2) == pytest.approx(0.1, abs=0.01)
    assert mean_u(100.2) == pytest.approx(100.2, abs=0.01)


def test_a_half_beyond_the_edge_is_cut_off() -> None:
    layers = np.zeros((1, 50, 50, 4), np.uint8)
    draw(layers, index=0, at_px=(-500.0, 20.0), first_half=False)
    draw(layers, index=0, at_px=(1e6, 1e6), first_half=True)
    draw(layers, index=0, at_px=(0.0, 0.0), first_half=False)
    assert layers[..., :3].any()


def test_arrows_nudge_and_steps_change() -> None:
    hand = Nudging(nominal(EYE, STACK, reference=1), [])
    u, v = hand.current.panel_px
    step = STEPS_PX[hand.step]
    for key in (Key.RIGHT, Key.RIGHT, Key.DOWN):
        hand.press(key)
    assert hand.current.panel_px == pytest.approx((u + 2 * step, v + step))
    hand.press(Key.FINER)
    hand.press(Key.LEFT)
    assert hand.current.panel_px == pytest.approx((u + 2 * step - STEPS_PX[hand.step], v + step))
    for _ in range(20):
        hand.press(Key.FINER)
    assert STEPS_PX[hand.step] == STEPS_PX[0]
    for _ in range(20):
        hand.press(Key.COARSER)
    assert STEPS_PX[hand.step] == STEPS_PX[-1]


def test_the_next_vernier_begins_with_the_correction_of_the_last() -> None:
    asked = nominal(EYE, STACK, reference=1)
    hand = Nudging(list(asked), [])
    hand.press(Key.RIGHT)
    assert hand.press(Key.ACCEPT)
    assert hand.current.panel_px == pytest.approx((asked[1].panel_px[0] + 1.0, asked[1].panel_px[1]))


def test_a_person_sets_all_verniers_and_each_is_kept_at_once(tmp_path: Path) -> None:
    asked = nominal(EYE, STACK, reference=1)[:4]
    keys = iter([Key.RIGHT, None, Key.ACCEPT, Key.ACCEPT, Key.PREVIOUS, Key.UP, Key.ACCEPT, Key.ACCEPT, Key.ACCEPT])
    kept: list[int] = []
    shown: list[np.ndarray] = []

    def keep(settings: list[Setting]) -> None:
        kept.append(len(settings))
        write_settings(tmp_path / "v.csv", settings)

    done = nudge(
        Nudging(list(asked), []), STACK, poll=lambda: next(keys), present=shown.append, wait=lambda: None, keep=keep,
        say=lambda text: None,
    )  # fmt: skip
    assert len(done) == 4
    assert kept == [1, 2, 2, 3, 4]
    assert len(read_settings(tmp_path / "v.csv", STACK)) == 4
    assert all(layers.shape == (3, 540, 960, 4) for layers in shown)


def test_settings_survive_a_file(tmp_path: Path) -> None:
    asked = nominal((0.43, 0.0123, -0.05), STACK, reference=1)
    write_settings(tmp_path / "v.csv", asked)
    for a, b in zip(asked, read_settings(tmp_path / "v.csv", STACK), strict=True):
        assert (a.reference, a.panel) == (b.reference, b.panel)
        np.testing.assert_allclose([*a.eye_m, *a.reference_px, *a.panel_px], [*b.eye_m, *b.reference_px, *b.panel_px],
                                   rtol=1e-8)  # fmt: skip


def test_it_resumes_at_the_first_vernier_that_is_open(tmp_path: Path) -> None:
    """Through a file, which rounds: nothing is asked twice, nothing is kept twice."""
    eye = (0.43, 1 / 3, -0.05)
    asked = nominal(eye, STACK, reference=1)
    first = Nudging(list(asked), [])
    for key in (Key.RIGHT, Key.ACCEPT, Key.NEXT, Key.UP, Key.ACCEPT, Key.QUIT):
        first.press(key)
    write_settings(tmp_path / "v.csv", first.done)
    second = resumed(asked, read_settings(tmp_path / "v.csv", STACK))
    assert second.index == 1
    assert not second.finished
    second.press(Key.ACCEPT)
    assert second.index == 2
    assert second.current.panel_px == pytest.approx(first.done[1].panel_px, abs=1e-5), "a taken one is left as it is"
    assert len(second.done) == 3
    for _ in asked[2:]:
        second.press(Key.ACCEPT)
    assert second.finished
    assert len(second.done) == len(asked)
    assert resumed(asked, second.done).finished


def test_settings_from_other_viewpoints_are_kept_beside(tmp_path: Path) -> None:
    others = nominal((0.6, 0.1, 0.0), STACK, reference=1)
    found = resumed(nominal(EYE, STACK, reference=1), others)
    assert found.index == 0
    assert found.done == others


HEADER = "reference,panel,eye_x,eye_y,eye_z,reference_u,reference_v,panel_u,panel_v\n"


@pytest.mark.parametrize(
    ("text", "wanted"),
    [
        ("", "reference: column is missing"),
        (HEADER + "1,3,0.5,0,0,1,2,3,4\n", "line 2, panel: must be 0 to 2"),
        (HEADER + "1,1,0.5,0,0,1,2,3,4\n", "line 2, panel: is its own reference"),
        (HEADER + "1,2,0.05,0,0,1,2,3,4\n", "line 2, eye_x"),
        (HEADER + "1,2,0.5,0,0,1,2,3,nan\n", "line 2, panel_v: is not a number"),
        (HEADER + "1,2,0.5,0,0,1,2,3\n", "line 2, panel_v: is not a number"),
    ],
)
def test_wrong_settings_are_refused_with_their_place(tmp_path: Path, text: str, wanted: str) -> None:
    (tmp_path / "v.csv").write_text(text)
    with pytest.raises(InputError, match=wanted):
        read_settings(tmp_path / "v.csv", STACK)
