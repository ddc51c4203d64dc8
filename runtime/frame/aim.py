"""Build solver requests: choose the effort, and predict the eyes for the display time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from runtime.clock import NS_PER_MS, NS_PER_S
from runtime.config import Settings
from runtime.frame.effort import HORIZON_S, Costs, EffortChooser, Outlook, candidates, display_spread_s
from runtime.frame.served import matched, moved_m2, sigma_factor
from runtime.frame.solver_host import SolverHost
from runtime.frame.viewer import Viewer
from runtime.model.solver import FOCUS_STEPS
from runtime.optics.alignment import midpoints
from runtime.plan.focusing import may_focus
from runtime.records import F64, Effort, EyesEstimate, EyesLabel, FrameTiming, Solution, SolveRequest

HORIZON_NS = NS_PER_S // 8  # how far ahead the eyes are predicted at most, from the current refresh's display time
SPEED_NS = NS_PER_S // 2  # time constant for the running mean of the head's squared speed
REQUESTS_KEPT = 256
CALM_M_S = 0.02  # a seated viewer's head sways more slowly than this; deliberate movements are faster
FOCUS_SHARE = 0.25  # a resting head's solution gets focus if this takes less than this share of the expected rest
WORTH = 0.995  # refine only if the expected error would fall below this share of the current error


@dataclass(frozen=True, slots=True)
class Slots:
    """Refreshes that show a solution, given when it begins: each shows the latest complete one."""

    photon_ns: int  # current refresh's display time
    composed_ns: int  # when the current refresh was composed
    begins_ns: int  # when the solution is expected to begin
    period_ns: int

    def middle_ns(self, cost_ns: int) -> int:
        """Return the middle of the display times of a solution that takes `cost_ns`, as long as the next."""
        first = max(self._refresh_after(cost_ns), 1)  # the current refresh is already composed
        end = max(self._refresh_after(2 * cost_ns), first + 1)
        return self.photon_ns + self.period_ns * (first + end - 1) // 2

    def _refresh_after(self, cost_ns: int) -> int:
        """Return how many refreshes later a solution is first shown that is complete `cost_ns` after `begins_ns`."""
        return -(-(self.begins_ns + cost_ns - self.composed_ns) // self.period_ns)


class Aim:
    """Builds solver requests during one run. Not thread-safe. Never reads a clock."""

    def __init__(self, viewer: Viewer, solver: SolverHost, *, period_ns: int, fixed: Effort | None = None) -> None:
        """Create an aim for one run. `fixed` is the effort if `model.effort` is `full`, by default all steps."""
        self._viewer, self._solver, self._period_ns, self._fixed = viewer, solver, period_ns, fixed
        self._chooser = EffortChooser()
        self._calm_ns: int | None = None  # when the head's speed fell below CALM_M_S
        self._expected: dict[int, float] = {}  # expected squared distance to the true eyes, m², by requested time
        # Effort chosen when the head was last seen. A lost head keeps it: the error at an unknown position favours long
        # solutions, and the solver would still be busy when the head returns.
        self._seen_effort: Effort | None = None
        self._speed2 = 0.0  # running mean of the squared speed, in (m/s)²
        self._learned: int | None = None  # number of the latest solution whose measures have been used

    def request(
        self,
        timing: FrameTiming,
        eyes: EyesEstimate,
        shown: Solution | None,
        settings: Settings,
        *,
        composed_ns: int,
        now_ns: int,
        flat_wanted: bool,
        paused: bool,
    ) -> SolveRequest:
        """Return the next solver request, posted at `now_ns` for a refresh composed at `composed_ns`.
        `flat_wanted`: the flat picture is shown or will be needed soon. `paused`: the operator has paused the picture.
        """
        self._learn(shown, eyes)
        begins_ns = min(max(self._solver.free_ns(now_ns), now_ns), now_ns + self._period_ns)  # else replaced by then
        slots = Slots(timing.photon_ns, composed_ns, begins_ns, self._period_ns)
        facts, refined, costs = self._solver.facts, None, self._solver.costs.for_people(len(eyes.people))
        whole = self._fixed or Effort(1, facts.model.steps)
        effort, expected_m2 = whole, 0.0
        timed = tuple(by for by in facts.model.reductions if by in costs.stages)  # a new model may lack timings
        if timed and eyes.eyes_m is not None and settings.model.effort == "auto":
            outlook = self._outlook(slots, eyes)
            horizon_s = self._horizon_s(timing, speed_m_s=outlook(0.0).speed_m_s)
            error = self._shown_error(eyes, shown, time_ns=timing.photon_ns)
            period_ms = self._period_ns / NS_PER_MS
            if eyes.label != "held" or self._seen_effort is None or self._seen_effort.reduction not in timed:
                self._seen_effort = self._chooser.choose(
                    candidates(timed, facts.model.steps),
                    costs, outlook, shown_error=error, period_ms=period_ms, horizon_s=horizon_s,
                )  # fmt: skip
            effort = self._seen_effort
            if shown is not None and eyes.label == "rested":
                most = facts.model.refined_steps
                refined = self._refined(shown, most, costs, shown_error=error, horizon_s=horizon_s)
                if refined is None and len(eyes.people) < 2 and may_focus(facts.info, settings.content.focus):
                    refined = focused(shown, most, costs, horizon_s=horizon_s)
            cost_ms = costs.ms(effort)
            expected_m2 = outlook(cost_ms).moved_m2(display_spread_s(cost_ms, period_ms=period_ms))
        cost_ns = round(costs.ms(effort) * NS_PER_MS)
        then_ns, then_m, label = self._eyes_then(slots, eyes, cost_ns=cost_ns)
        self._expected[then_ns] = expected_m2
        while len(self._expected) > REQUESTS_KEPT:
            self._expected.pop(next(iter(self._expected)))
        # When the solution is shown, it is aligned to newer eyes, so only the current eyes' uncertainty matters.
        return SolveRequest(then_ns, then_m, label, eyes.sigma_m, flat_wanted, paused, effort, refined, eyes.people)

    def _learn(self, shown: Solution | None, eyes: EyesEstimate) -> None:
        """Update the statistics from the latest solution's measures and from how far the eyes have moved."""
        if shown is None or shown.solved_for_m is None:
            return
        expected_m2 = self._expected.get(shown.solved_for_ns, 0.0)
        if expected_m2 > 0.0 and eyes.eyes_m is not None and eyes.label != "held":
            found_m2 = moved_m2(*matched(shown, eyes))
            self._chooser.foresight.learn(expected_m2=expected_m2, found_m2=found_m2)
        if shown.number != self._learned and shown.measures is not None and shown.effort is not None:
            self._learned = shown.number
            self._chooser.pictures.learn(shown.measures, shown.effort)

    def _eyes_then(self, slots: Slots, eyes: EyesEstimate, *, cost_ns: int) -> tuple[int, F64 | None, EyesLabel]:
        """Return the time to solve for, the eyes (2, 3) predicted for that time, and their label. The eyes are
        predicted at most `HORIZON_NS` beyond the display time.
        """
        middle_ns = slots.middle_ns(cost_ns)
        reach_ns = min(middle_ns, slots.photon_ns + HORIZON_NS)
        then = self._viewer.ahead(reach_ns) if eyes.eyes_m is not None else eyes
        if then.eyes_m is None or eyes.eyes_m is None or then.people != eyes.people:
            return middle_ns, eyes.eyes_m, eyes.label
        # A person who hardly moves keeps their place when others move.
        people_m2 = [float((step_m**2).sum()) for step_m in midpoints(then.eyes_m - eyes.eyes_m)]
        rests, error_m2 = then.label == "rested", 2 * then.sigma_m**2
        shares = [m2 / (m2 + error_m2) if m2 > 0.0 and not rests else 1.0 for m2 in people_m2]
        return middle_ns, eyes.eyes_m + np.repeat(shares, 2)[:, None] * (then.eyes_m - eyes.eyes_m), then.label

    def _outlook(self, slots: Slots, eyes: EyesEstimate) -> Callable[[float], Outlook]:
        far_ns = max(HORIZON_NS, self._period_ns)
        near = self._viewer.ahead(slots.photon_ns + self._period_ns)
        far = self._viewer.ahead(slots.photon_ns + far_ns)
        if far.label == "rested":
            self._speed2 = 0.0
            return lambda cost_ms: Outlook()
        seen = {each.people if each.eyes_m is not None else None for each in (eyes, near, far)}
        if eyes.eyes_m is None or near.eyes_m is None or len(seen) > 1:  # a lost head, soon given up
            lost = Outlook(eyes.sigma_m, self._speed2**0.5)
            return lambda cost_ms: lost
        factor = sigma_factor(len(eyes.people))
        unsure_m = factor * max(near.sigma_m - eyes.sigma_m, 0.0)  # explains this much movement along each axis
        near_m2 = moved_m2(eyes.eyes_m, near.eyes_m)
        speed_m_s = self._usual_speed_m_s(max(near_m2 - 2 * unsure_m**2, 0.0) ** 0.5, eyes)

        # At 8 Hz or less, both times are the same, and so are both deviations.
        growth_m = max(far.sigma_m - near.sigma_m, 0.0) / max(far_ns - self._period_ns, 1)

        def outlook(cost_ms: float) -> Outlook:
            ahead_ns = slots.middle_ns(round(cost_ms * NS_PER_MS)) - slots.photon_ns
            sigma_m = factor * (near.sigma_m + growth_m * (ahead_ns - self._period_ns))
            beyond_s = max(ahead_ns - HORIZON_NS, 0) / NS_PER_S
            return Outlook(sigma_m, speed_m_s, beyond_s * speed_m_s)

        return outlook

    def _horizon_s(self, timing: FrameTiming, *, speed_m_s: float) -> float:
        """Return how long the head is expected to keep moving as it does now, in seconds. A calm head is expected to
        stay calm for as long as it has already been calm, and for `HORIZON_S` more.
        """
        if speed_m_s > CALM_M_S:
            self._calm_ns = None
            return HORIZON_S
        if self._calm_ns is None:
            self._calm_ns = timing.photon_ns
        return HORIZON_S + (timing.photon_ns - self._calm_ns) / NS_PER_S

    def _usual_speed_m_s(self, moved_m: float, eyes: EyesEstimate) -> float:
        """Return the larger of the head's current speed and its recent RMS, for turning points and lost eyes."""
        speed_m_s = moved_m * NS_PER_S / self._period_ns
        if eyes.label != "held":
            gain = self._period_ns / (self._period_ns + SPEED_NS)
            self._speed2 += gain * (speed_m_s**2 - self._speed2)
        return float(max(speed_m_s if eyes.label != "held" else 0.0, self._speed2**0.5))

    def _shown_error(self, eyes: EyesEstimate, shown: Solution | None, *, time_ns: int) -> float:
        """Return the squared light error to expect from the latest solution at a given time."""
        pictures = self._chooser.pictures
        if shown is None or shown.effort is None or shown.solved_for_m is None or eyes.eyes_m is None:
            return pictures.contrast
        if set(eyes.people) - set(shown.people) and len(eyes.people) > 1:
            return pictures.contrast  # somebody waits for a picture
        then_m, now_m = matched(shown, eyes)
        moved_m = moved_m2(then_m, now_m) ** 0.5
        return pictures.own(shown.effort) + pictures.stale(moved_m, (time_ns - shown.solved_for_ns) / NS_PER_S)

    def _refined(
        self, shown: Solution, most: int, costs: Costs, *, shown_error: float, horizon_s: float
    ) -> Effort | None:
        """Return the effort, of at most `most` steps, to refine a resting head's solution to, or None to keep it."""
        done, pictures = shown.effort, self._chooser.pictures
        if done is None:
            return None
        efforts = [Effort(by, 0) for by in costs.stages if by < done.reduction]
        if done.reduction == 1:
            efforts += [Effort(1, steps, done.steps) for steps in (done.steps + 1, done.steps + 2) if steps <= most]
        if not efforts:
            return None
        mean, horizon = self._chooser.mean_error, {"shown_error": shown_error, "horizon_s": horizon_s}
        means = {effort: mean(pictures.own(effort), costs.ms(effort), **horizon) for effort in efforts}
        best = min(means, key=means.__getitem__)
        return best if means[best] < WORTH * shown_error else None


def focused(shown: Solution, most: int, costs: Costs, *, horizon_s: float) -> Effort | None:
    """Return the effort that gives a resting head's solution, otherwise final, focus, or None. A model
    that runs `most` steps, if any, can do so.
    """
    if shown.effort is None or shown.effort.reduction > 1 or shown.effort.focus or most < 1:
        return None
    effort = Effort(1, FOCUS_STEPS, focus=True)
    return effort if costs.ms(effort) < FOCUS_SHARE * 1e3 * horizon_s else None
