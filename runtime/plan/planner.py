"""Makes the plan of a run anew, for whatever content, viewer and model there are at the moment."""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace

from runtime.config import Settings
from runtime.content.base import ContentInfo
from runtime.model.predictor import Predictor
from runtime.optics.stack import PanelStack
from runtime.plan.focus import FocusedPredictor
from runtime.plan.reduced import ReducedPredictor
from runtime.plan.savings import Measured, Plan, make_plan


@dataclass(frozen=True, slots=True)
class Planner:
    """The settings and panels that every plan of a run is made for."""

    settings: Settings
    stack: PanelStack

    def plan(
        self,
        info: ContentInfo,
        predictor: Predictor,
        *,
        seeing: tuple[bool, bool] = (True, True),
        measured: Measured | None = None,
    ) -> Plan:
        """seeing: which eyes can see the display; measured: what is known of times and errors by now."""
        return make_plan(
            info,
            self.stack,
            self.settings,
            seeing=seeing,
            measured=measured,
            can_focus=focused_part(predictor) is not None,
            loaded_modules=sys.modules,
        )


def observed(measured: Measured, predictor: Predictor) -> Measured:
    """The same with what the predictor left out of its last frame."""
    inner = predictor.small if isinstance(predictor, ReducedPredictor) else predictor
    fraction = inner.active_fraction if isinstance(inner, FocusedPredictor) else 1.0
    return replace(measured, channels=inner.channels, active_fraction=fraction)


def focused_part(predictor: Predictor) -> FocusedPredictor | None:
    """The part of a predictor that runs on windows; None where it runs on the whole panels alone."""
    inner = predictor.small if isinstance(predictor, ReducedPredictor) else predictor
    return inner if isinstance(inner, FocusedPredictor) else None
