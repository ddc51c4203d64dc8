"""Tests that refreshes stay on the display's grid, and that only late ones are counted."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from runtime.clock import NS_PER_MS
from runtime.frame.pacing import LATE_SHARE, Pacer
from runtime.records import FrameTiming

PERIOD_NS = 16 * NS_PER_MS
PHOTON_NS = 8 * NS_PER_MS
SHORT_NS = st.integers(0, 4 * PERIOD_NS)


def pacer(*, period_ns: int = PERIOD_NS, work_ns: int = 0) -> Pacer:
    return Pacer(period_ns=period_ns, photon_ns=PHOTON_NS, work_ns=work_ns)


@dataclass
class Display:
    """Vertical blanks at regular times; a picture that is ready appears at the next one."""

    period_ns: float
    phase_ns: float = 0.0

    def blank_after(self, time_ns: float) -> int:
        return round(np.ceil((time_ns - self.phase_ns) / self.period_ns) * self.period_ns + self.phase_ns)


def refresh(pacer: Pacer, display: Display, now_ns: int, *, work_ns: int) -> tuple[FrameTiming, int]:
    """One refresh on a display: its timing, and the blank it was shown at."""
    timing = pacer.predict(now_ns)
    woke_ns = max(now_ns, timing.wake_ns)
    blank_ns = display.blank_after(woke_ns + work_ns)
    pacer.presented(timing, woke_ns=woke_ns, done_ns=blank_ns, blank_ns=blank_ns)
    return timing, blank_ns


def test_the_first_refresh_comes_at_once_with_light_after_the_scan_out() -> None:
    timing = pacer(work_ns=2 * NS_PER_MS).predict(1000)
    assert timing == FrameTiming(0, 1000, 1000 + 2 * NS_PER_MS, 1000 + 2 * NS_PER_MS + PHOTON_NS)


def test_a_frame_that_can_be_held_is_late_only_rarely() -> None:
    """Work that takes longer at one refresh in ten, by a third of a period."""
    paced, now_ns, late = pacer(), 0, 0
    random = np.random.default_rng(1)
    for number in range(2000):
        timing = paced.predict(now_ns)
        woke_ns = max(now_ns, timing.wake_ns)
        ready_ns = woke_ns + (10 if random.random() < 0.1 else 5) * NS_PER_MS
        now_ns = max(ready_ns, timing.present_ns)
        paced.presented(timing, woke_ns=woke_ns, done_ns=now_ns, held_ns=now_ns - ready_ns)
        late += number > 200 and ready_ns > timing.present_ns + NS_PER_MS
    assert late < 0.03 * 2000


def test_refreshes_that_draw_nothing_do_not_make_the_next_frame_late() -> None:
    paced, now_ns = pacer(), 0
    for number in range(400):
        timing = paced.predict(now_ns)
        woke_ns = max(now_ns, timing.wake_ns)
        if number % 4:
            now_ns = woke_ns + NS_PER_MS
            shown_ns = paced.presented(timing, woke_ns=woke_ns, done_ns=now_ns)
            assert number < 40 or shown_ns == timing.present_ns + PHOTON_NS  # the old picture stays, on time
            continue
        ready_ns = woke_ns + 12 * NS_PER_MS
        now_ns = max(ready_ns, timing.present_ns)
        paced.presented(timing, woke_ns=woke_ns, done_ns=now_ns, held_ns=now_ns - ready_ns)
        assert number < 40 or ready_ns <= timing.present_ns + NS_PER_MS


def test_a_late_held_frame_is_told_late_even_after_outputs_with_blanks() -> None:
    paced = pacer()
    timing = paced.predict(0)
    paced.presented(timing, woke_ns=0, done_ns=NS_PER_MS, blank_ns=NS_PER_MS)
    timing = paced.predict(PERIOD_NS)
    late_ns = timing.present_ns + 3 * NS_PER_MS
    assert paced.presented(timing, woke_ns=PERIOD_NS, done_ns=late_ns, held_ns=0) == late_ns + PHOTON_NS


@pytest.mark.parametrize(("late_periods", "skipped"), [(0.4, 0), (0.6, 1), (1.4, 1), (1.6, 2), (10.6, 11)])
def test_a_late_refresh_takes_a_later_slot_and_skipped_ones_are_missed(late_periods: float, skipped: int) -> None:
    paced = pacer()
    first = paced.predict(0)
    now_ns = first.wake_ns + PERIOD_NS + round(late_periods * PERIOD_NS)
    timing = paced.predict(now_ns)
    assert timing.present_ns == first.present_ns + (1 + skipped) * PERIOD_NS
    assert paced.missed == skipped
    assert timing.id == 1  # refreshes are numbered, not slots


@given(st.lists(st.tuples(SHORT_NS, st.integers(0, 3 * PERIOD_NS)), max_size=60), st.integers(0, PERIOD_NS))
def test_slots_always_ascend_on_one_grid_and_none_starts_far_too_late(
    story: list[tuple[int, int]], work_ns: int
) -> None:
    """story: for each refresh, how long it worked, and what else held it up."""
    paced, now_ns = pacer(work_ns=work_ns), 12_345
    first = last = None
    for number, (spent_ns, held_up_ns) in enumerate(story):
        timing = paced.predict(now_ns)
        first = first or timing
        assert timing.id == number
        assert (timing.present_ns - first.present_ns) % PERIOD_NS == 0
        assert timing.wake_ns <= timing.present_ns < timing.photon_ns == timing.present_ns + PHOTON_NS
        assert timing.wake_ns >= now_ns - LATE_SHARE * PERIOD_NS - 1
        if last is not None:
            assert timing.present_ns > last.present_ns
        # Every slot since the first was either a refresh's or is counted as missed.
        assert (timing.present_ns - first.present_ns) // PERIOD_NS == number + paced.missed
        woke_ns = max(now_ns, timing.wake_ns)
        now_ns, last = woke_ns + spent_ns, timing
        paced.presented(timing, woke_ns=woke_ns, done_ns=now_ns)
        now_ns += held_up_ns


def test_without_blanks_the_light_is_told_from_when_presenting_was_done() -> None:
    paced = pacer()
    timing = paced.predict(0)
    assert paced.presented(timing, woke_ns=0, done_ns=5 * NS_PER_MS) == 5 * NS_PER_MS + PHOTON_NS


def test_the_working_time_of_a_refresh_is_learnt_for_its_wake_up() -> None:
    paced, now_ns = pacer(), 0
    for _ in range(40):
        timing = paced.predict(now_ns)
        woke_ns = max(now_ns, timing.wake_ns)
        now_ns = woke_ns + 4 * NS_PER_MS
        paced.presented(timing, woke_ns=woke_ns, done_ns=now_ns)
    assert abs(lead(paced) - 4 * NS_PER_MS) < NS_PER_MS / 10


@given(st.floats(0, 1), st.floats(0.998, 1.002))
def test_refreshes_follow_the_display_s_own_drifting_blanks(phase: float, pace: float) -> None:
    """The configured period is a nominal one; a monitor's own differs, and its phase is anything."""
    display = Display(period_ns=pace * PERIOD_NS, phase_ns=phase * PERIOD_NS)
    paced, now_ns = pacer(), 0
    errors = []
    for _ in range(400):
        timing, now_ns = refresh(paced, display, now_ns, work_ns=NS_PER_MS // 2)
        errors.append(timing.present_ns - now_ns)
    # A phase is learnt by a tenth a refresh: a drift of 0.2% a refresh is followed ten times as far behind.
    assert np.abs(errors[200:]).max() <= 0.025 * PERIOD_NS


def test_a_missed_blank_is_counted_once_and_the_next_refresh_avoids_it() -> None:
    display, paced = Display(PERIOD_NS), pacer(work_ns=NS_PER_MS)
    now_ns, blanks = 0, []
    for number in range(60):
        work_ns = 20 * NS_PER_MS if number == 40 else NS_PER_MS
        _, now_ns = refresh(paced, display, now_ns, work_ns=work_ns)
        blanks.append(now_ns)
    intervals = np.diff(blanks) / PERIOD_NS
    lost = round(float((intervals[20:] - 1).sum()))
    assert lost >= 1
    assert (intervals[45:] == 1).all()  # it was one hiccup
    assert paced.missed >= lost


def lead(paced: Pacer) -> int:
    timing = paced.predict(0)
    return timing.present_ns - timing.wake_ns


@pytest.mark.parametrize("work_ms", [0.5, 3.0, 6.0])
def test_a_slow_display_misses_next_to_no_blank_once_it_is_known(work_ms: float) -> None:
    display, paced, now_ns = Display(PERIOD_NS, phase_ns=5 * NS_PER_MS), pacer(), 0
    blanks = []
    for _ in range(4000):
        _, now_ns = refresh(paced, display, now_ns, work_ns=round(work_ms * NS_PER_MS))
        blanks.append(now_ns)
    intervals = np.diff(blanks[1000:]) / PERIOD_NS
    assert np.mean(intervals > 1.5) <= 0.004


def test_a_deliberately_skipped_refresh_keeps_its_slot_and_is_not_missed() -> None:
    display, paced, now_ns = Display(PERIOD_NS), pacer(), 0
    for _ in range(20):
        _, now_ns = refresh(paced, display, now_ns, work_ns=NS_PER_MS // 4)
    missed, last = paced.missed, None
    for _ in range(200):  # unchanged: the sink does not swap and reports no blank
        timing = paced.predict(now_ns)
        woke_ns = max(now_ns, timing.wake_ns)
        now_ns = woke_ns + NS_PER_MS // 10
        photon_ns = paced.presented(timing, woke_ns=woke_ns, done_ns=now_ns)
        assert photon_ns == timing.present_ns + PHOTON_NS  # the old picture is shown until its slot
        if last is not None:
            assert timing.present_ns - last == PERIOD_NS
        last = timing.present_ns
    assert paced.missed == missed
    timing, blank_ns = refresh(paced, display, now_ns, work_ns=NS_PER_MS // 4)
    assert blank_ns - timing.present_ns < PERIOD_NS / 2
    assert paced.missed == missed


def test_work_is_not_forgotten_while_pictures_are_left_out() -> None:
    """After a rest the first motion must not miss blanks because nothing had to be drawn for a while."""
    display, paced, now_ns = Display(PERIOD_NS), pacer(), 0
    for _ in range(600):
        _, now_ns = refresh(paced, display, now_ns, work_ns=4 * NS_PER_MS)
    for _ in range(600):
        timing = paced.predict(now_ns)
        now_ns = max(now_ns, timing.wake_ns) + NS_PER_MS // 10
        paced.presented(timing, woke_ns=now_ns - NS_PER_MS // 10, done_ns=now_ns)
    missed = paced.missed
    for _ in range(60):
        _, now_ns = refresh(paced, display, now_ns, work_ns=4 * NS_PER_MS)
    assert paced.missed <= missed + 1


@pytest.mark.parametrize(
    ("work_ms", "held_ms", "lead_ms"),
    [
        ([3.0], None, 1.5),  # half of an increase is believed at once
        ([160.0], None, 4.0),  # a stall of ten periods counts as half a period of work
        ([160.0] * 60, None, 8.0),
        ([160.0] * 60 + [0.0], None, 7.6),  # a twentieth of a decrease
        ([160.0] * 60, 0.0, 14.4),  # nine tenths of a period if drawn frames wait until they are due
        ([160.0] * 60 + [0.0], 0.0, 14.256),  # and a hundredth of a decrease
        ([5.0], 2.0, 1.5),  # waiting is not work
    ],
)
def test_work_times_are_learnt_within_limits(work_ms: list[float], held_ms: float | None, lead_ms: float) -> None:
    paced = pacer()
    held_ns = None if held_ms is None else round(held_ms * NS_PER_MS)
    for spent_ms in work_ms:
        timing = paced.predict(0)
        paced.presented(timing, woke_ns=0, done_ns=round(spent_ms * NS_PER_MS), held_ns=held_ns)
    assert lead(paced) == pytest.approx(lead_ms * NS_PER_MS, rel=1e-6)


def test_each_missed_blank_widens_the_margin_up_to_half_a_period() -> None:
    paced, leads = pacer(), []
    for _ in range(10):
        timing = paced.predict(0)
        paced.presented(timing, woke_ns=0, done_ns=0, blank_ns=timing.present_ns + PERIOD_NS)
        leads.append(lead(paced) / NS_PER_MS)
    assert leads == pytest.approx([1.5, 2.25, 3.375, 5.0625, 7.59375, 8.0, 8.0, 8.0, 8.0, 8.0])
    assert paced.missed >= 10
    timing = paced.predict(0)
    paced.presented(timing, woke_ns=0, done_ns=0, blank_ns=timing.present_ns)
    assert lead(paced) == pytest.approx(0.9995 * 8.0 * NS_PER_MS)


def test_a_tenth_of_a_blanks_error_moves_the_next_refresh() -> None:
    paced = pacer()
    timing = paced.predict(0)
    paced.presented(timing, woke_ns=0, done_ns=0, blank_ns=timing.present_ns + 2 * NS_PER_MS)
    assert paced.predict(0).present_ns == timing.present_ns + PERIOD_NS + NS_PER_MS // 5


def test_a_held_frame_needs_no_margin_for_blanks_seen_before() -> None:
    paced = pacer()
    timing = paced.predict(0)
    paced.presented(timing, woke_ns=0, done_ns=0, blank_ns=timing.present_ns)
    assert lead(paced) == NS_PER_MS
    timing = paced.predict(0)
    paced.presented(timing, woke_ns=0, done_ns=0, held_ns=0)
    assert lead(paced) == 0


@pytest.mark.parametrize("period_ns", [0, -1])
def test_a_period_that_is_not_positive_is_refused(period_ns: int) -> None:
    with pytest.raises(ValueError, match="period_ns"):
        pacer(period_ns=period_ns)
