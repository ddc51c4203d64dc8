"""Puts a run together from its settings: the composition root below the command line."""

from __future__ import annotations

import logging
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from runtime.clock import Clock, MonotonicClock, SimulatedClock
from runtime.config import Settings
from runtime.records import FrameAccount

if TYPE_CHECKING:
    from runtime.frame.loop import Loop, Supervisor
    from runtime.frame.pipeline import Pipeline
    from runtime.optics.stack import PanelStack
    from runtime.sensor.base import SensorDriver

log = logging.getLogger("phasestack.assembly")

WARM_EYES_M = ((0.6, -0.031, 0.0), (0.6, 0.031, 0.0))


@dataclass(frozen=True, slots=True)
class RunOptions:
    """What the command line says beside the configuration."""

    max_speed: bool = False
    measure: bool = False
    scale: float = 1.0


def scaled_stack(settings: Settings, scale: float) -> PanelStack:
    """The configured stack with `scale` times its pixels."""
    stack = settings.stack.stack()
    if scale == 1.0:
        return stack
    return replace(
        stack, width_px=max(16, round(stack.width_px * scale)), height_px=max(16, round(stack.height_px * scale))
    )


def build_pipeline(settings: Settings, stack: PanelStack, context: Any, on_fault: Callable[[str], None]) -> Pipeline:
    """Content and model. Raises FatalError; leaves nothing open then."""
    from runtime.content.registry import open_content
    from runtime.frame.pipeline import Pipeline
    from runtime.plan.planner import Planner
    from runtime.plan.planning import planned_predictor

    predictor = planned_predictor(settings, stack)
    try:
        content = open_content(settings.content, stack, context)
    except BaseException:
        predictor.close()
        raise
    planner = Planner(settings, stack)
    return Pipeline(stack, content=content, predictor=predictor, planner=planner, on_fault=on_fault)


def build_loop(
    settings: Settings,
    options: RunOptions,
    cleanup: ExitStack,
    *,
    supervisor: Supervisor | None = None,
    on_account: Callable[[FrameAccount], None] | None = None,
    wait_for_panels: Callable[[str], bool] | None = None,
    on_start: Callable[[str], bool] = lambda _: True,
) -> Loop:
    """A loop ready for its first turn; whatever it holds is closed by `cleanup`.

    wait_for_panels: asked when a panel is not there yet; True: try again. on_start: told what takes long before the
    first turn; False: leave it. Raises FatalError, PanelLost.
    """
    import cv2
    import numpy as np

    from runtime.evaluation.probe import QualityProbe
    from runtime.eyes.calibration import load_calibration
    from runtime.eyes.detect import EyeFinder
    from runtime.eyes.tracker import Tracker
    from runtime.frame.inputs import Input, LiveInput, SteppedInput
    from runtime.frame.loop import Loop
    from runtime.plan.budget import BudgetControl
    from runtime.sensor.detecting import DetectingDriver
    from runtime.sensor.registry import open_sensor
    from runtime.support.gl import offscreen_context

    cv2.setNumThreads(settings.model.threads or -1)
    clock: Clock = SimulatedClock() if options.max_speed else MonotonicClock()
    stack = scaled_stack(settings, options.scale)
    calibration = load_calibration(Path(settings.calibration.file) if settings.calibration.file else None)

    def make_driver() -> SensorDriver:
        driver = open_sensor(settings.sensor, clock, latency_ms=settings.loop.sensor_latency_ms)
        return DetectingDriver(driver, lambda: EyeFinder(settings.detector).find)

    driver = make_driver()
    source: Input
    for warning in calibration.warnings:
        log.warning("%s", warning)
    if options.max_speed:
        source = SteppedInput(driver, clock)
        cleanup.callback(source.close)
    context = offscreen_context()
    cleanup.callback(context.release)
    panels = _open_panels(settings, stack, clock, context, wait_for_panels)
    cleanup.callback(panels.close)
    faults: dict[str, Loop] = {}
    pipeline = build_pipeline(settings, stack, context, lambda part: faults["loop"].fault(part))
    cleanup.callback(lambda: faults["loop"].pipeline.close() if faults else pipeline.close())
    pipeline.predictor.warm_up(np.array(WARM_EYES_M))
    budget = BudgetControl(settings, pipeline, simulated=options.max_speed)
    cleanup.callback(budget.close)
    budget.start(on_start)
    if not options.max_speed:
        source = LiveInput(make_driver, settings.sensor, clock)
        cleanup.callback(source.close)
    loop = Loop(
        settings,
        clock=clock,
        context=context,
        budget=budget,
        source=source,
        calibration=calibration,
        tracker=Tracker(settings.tracker),
        pipeline=pipeline,
        panels=panels,
        supervisor=supervisor,
        probe=QualityProbe(stack, fov_deg=settings.content.fov_deg) if options.measure else None,
        on_account=on_account,
        in_stack_frame=driver.capabilities.in_stack_frame,
    )
    faults["loop"] = loop
    return loop


def _open_panels(
    settings: Settings, stack: PanelStack, clock: Clock, context: Any, wait: Callable[[str], bool] | None
) -> Any:
    from runtime.errors import PanelLost
    from runtime.panels.registry import open_panels

    while True:
        try:
            return open_panels(settings.output, stack, clock, context)
        except PanelLost as error:
            if wait is None or not wait(str(error)):
                raise
