"""Pass each refresh on to the quality sampler and to the writers of frames.jsonl and of saved layers."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from runtime.clock import NS_PER_S
from runtime.evaluation.contact_sheet import Moment
from runtime.frame.kept_light import KeptLight, Output
from runtime.frame.measuring import MeasuringProcess
from runtime.frame.refresh import Refresh
from runtime.frame.refresh_lines import RefreshLines
from runtime.frame.sampling import QualitySampler, has_picture
from runtime.frame.targets import TargetDrawer
from runtime.frame.truth import TrueEyes
from runtime.optics.stack import PanelStack
from runtime.records import RefreshAccount, SensorFrame


class RunObserver:
    """Records and measures a run's samples and refreshes; after the run, `finish` completes the records."""

    def __init__(
        self,
        stack: PanelStack,
        drawer: TargetDrawer,
        measuring: MeasuringProcess,
        *,
        evaluate_every: int | None = None,
        keep_light: int = 0,
        output: Output | None = None,
        on_account: Callable[[RefreshAccount], None] | None = None,
        simulated: bool = False,
        newest: bool = False,
    ) -> None:
        """Create an observer for one run, whose files go to `output`. Quality is measured at every `evaluate_every`-th
        refresh and the last one, only the last if 0, none if None, or with `newest` whenever the newest refresh's light
        is unknown. Every `keep_light`-th refresh's layers are saved.
        """
        self._measures, self._simulated, self._on_account = evaluate_every is not None, simulated, on_account
        self.last: Refresh | None = None
        self.truth = TrueEyes()
        self._lines = RefreshLines(self.truth, output.refresh if output is not None else None)
        self._sampler = QualitySampler(
            stack,
            drawer,
            self.truth,
            measuring,
            every=evaluate_every or 0,
            simulated=simulated,
            newest=newest,
        )
        self._kept = KeptLight(keep_light, output, drawer, self.truth, simulated=simulated) if output else None

    @property
    def moment(self) -> Moment | None:
        """The latest refresh whose quality was measured."""
        return self._sampler.moment

    @property
    def measured(self) -> dict[str, list[float]]:
        """Quality figures for the sampled refreshes, keyed by name."""
        return self._sampler.measured

    @property
    def live_errors(self) -> dict[int, float]:
        """Mean squared error of the light reaching the true eyes, keyed by refresh number."""
        return self._sampler.live

    def measure_only_live(self) -> None:
        """From now on, measure only live quality, which takes a sixth of the time."""
        self._sampler.only_live = True

    def sampled(self, sample: SensorFrame) -> None:
        if sample.true_eyes_m is not None:
            self.truth.add(sample.capture_ns, sample.true_eyes_m)

    def refreshed(self, refresh: Refresh) -> None:
        self.last = refresh
        self.truth.meet(refresh.account)
        if self._on_account is not None:
            self._on_account(refresh.account)
        self._lines.add(refresh.account)
        self._sampler.refreshed(refresh)
        if self._kept is not None:
            self._kept.refreshed(refresh)
        self._lines.advance()
        self._sampler.advance()

    def finish(self, stopped: Callable[[], bool] = lambda: False) -> None:
        """Complete the run's records after its last refresh, until `stopped`. All queued refreshes are
        written and measured, and target pictures are drawn for each refresh whose layers were saved. The last refresh
        is also measured, but in real time only if no other refresh has been measured.
        """
        self.truth.end()
        self._lines.advance()
        if self._kept is not None:
            self._kept.finish(stopped)
        self._sampler.drain(stopped)
        if self._simulated or (self.moment is None and not stopped()):
            last = self.last
            if last is not None and self._measures and has_picture(last) and last.account.eyes_m is not None:
                self._sampler.finish(last)
        if self._measures and self.last is not None and not stopped():
            self._sampler.measure_retina(self.last)

    def live(self) -> dict[str, Any]:
        """Return the live quality measured so far, for the daemon's status (docs/contracts.md, Error)."""
        return {"live_db": self._sampler.live_db, "view_error_mm": self._lines.view_error_mm.of("p50", "p95")}

    def light(self, refresh: Refresh | None) -> dict[str, Any]:
        """Return the light measured for a refresh's eyes, content and model, for the status. `light_db`,
        `light_age_s` and `measured_frame` are None if these have changed since, or a better solution was found.
        """
        moment = None if refresh is None else self._sampler.figure_of(refresh)
        if refresh is None or moment is None or moment.account is None:
            return dict.fromkeys(("light_db", "light_age_s", "measured_frame"))
        age_s = round(max(0, refresh.account.photon_ns - moment.account.photon_ns) / NS_PER_S, 1)
        light_db = round(moment.light_db, 2)
        return {"light_db": light_db, "light_age_s": age_s, "measured_frame": moment.account.frame}

    def summary(self) -> dict[str, Any]:
        """Return the quality figures for summary.json. Any figure that was not measured is null."""
        return {**self.live(), **self._sampler.summary(), "people": self.people()}

    def people(self) -> list[dict[str, Any]]:
        """Return the live quality and view error of each person served whose true eyes are known."""
        live_db, errors_mm = self._sampler.live_db_of_people, self._lines.people_mm
        return [
            {
                "number": number,
                "live_db": live_db.get(number),
                "view_error_mm": errors_mm[number].of("p50", "p95") if number in errors_mm else None,
            }
            for number in sorted(errors_mm.keys() | live_db.keys())
        ]
