"""Null controls: impostors that solve nothing take each stage's trials, and must fail most of them.

A suite that an impostor passes says nothing of the code that passes it too. Each control is a case of its own: how
many of its stage's cases the impostor passes, which may be half at most.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np

from runtime.optics.retina import seen_by
from runtime.optics.stack import PanelStack
from runtime.optics.views import image_from_stack
from runtime.records import F32, F64, U8
from runtime.report.baselines import EyeOperator, as_codes, conjugate_gradients, eye_operator, mean_of_targets
from runtime.report.eyesight import as_intensity
from runtime.report.pairs import eyes_at
from runtime.report.stability import calibration, networks, phases, poses, retina, rpu, solve, tracking, uncertainty
from runtime.report.stability.calibration import Fit
from runtime.report.stability.limits import key_of
from runtime.report.stability.trial import Answer, Trial, settle

STAGE = "controls"
MOST = 0.5  # of its stage's cases an impostor may pass


@dataclass(frozen=True, slots=True)
class Control:
    """An impostor in a stage."""

    stage: str
    name: str
    trials: Callable[[], Iterable[Trial]]  # the stage's cases, with the impostor in place of the code under trial


def passed(control: Control, limits: Mapping[str, float]) -> tuple[int, int]:
    """How many of the stage's cases the impostor passes, and how many there are."""
    trials = list(control.trials())
    return sum(settle(trial, limit=limits.get(key_of(trial))).passed for trial in trials), len(trials)


def trials(limits: Mapping[str, float], fits: Mapping[str, Fit]) -> Iterator[Trial]:
    """A case a control: the share of its stage's cases that the impostor passes."""
    for control in controls(fits):
        yield Trial(STAGE, f"{control.stage}: {control.name}", partial(_share, control, limits), measure="of its cases")


def _share(control: Control, limits: Mapping[str, float]) -> Answer:
    done, count = passed(control, limits)
    return Answer(done / count, MOST, note=f"passes {done} of the stage's {count} cases")


# ---- impostors


def nothing(*_: object, **__: object) -> Any:
    """Refuses whatever it is asked."""
    raise ValueError("no")


def first_pose(eye: Any) -> F64:
    """(4, 4) the pose of an eye straight ahead, wherever the eye is."""
    pose = np.eye(4)
    pose[:3, :3] = [[0, 0, 1], [1, 0, 0], [0, 1, 0]]
    pose[:3, 3] = eye
    return pose


def straight_projection(eye: Any, *, width_px: int, height_px: int, fov_deg: float) -> F64:
    """(3, 4) as if every eye were straight ahead."""
    return image_from_stack([0.6, 0.0, 0.0], width_px=width_px, height_px=height_px, fov_deg=fov_deg)


def unmoved(eye: Any, *, from_x_m: float, to_x_m: float) -> tuple[float, F64]:
    """Scale and (2,) shift without a parallax."""
    return 1.0, np.zeros(2)


def unwarped(*_: object, **__: object) -> F64:
    """A picture's pixels are the panel's."""
    return np.eye(3)


def central_positions(eye: Any, stack: PanelStack, *, index: int, width_px: int, height_px: int, fov_deg: float) -> Any:
    """Each ray meets each panel at its own pixel."""
    v, u = np.mgrid[0:height_px, 0:width_px].astype(np.float32) + np.float32(0.5)
    return u, v


def no_wave(values: Any, branch: int = 1) -> Any:
    """Phase and intensity are the same."""
    return np.asarray(values)


def grey_retina(eye: Any, layers: U8, stack: PanelStack, *, fov_deg: float, **size: int) -> Any:
    """Half of white, everywhere, and every ray counts."""
    height, width = size.get("height_px", layers.shape[1]), size.get("width_px", layers.shape[2])
    return SimpleNamespace(image=np.full((height, width, 3), 0.5, np.float32), mask=np.ones((height, width), bool))


def flat_retina(eye: Any, layers: U8, stack: PanelStack, *, fov_deg: float, **size: int) -> Any:
    """The layers one on the other as they lie, without the eye."""
    real = seen_by([1e6, 0.0, 0.0], layers, stack, fov_deg=fov_deg)
    total = layers.astype(np.float32).sum(0)[..., :3] / 255
    return SimpleNamespace(image=np.sin(np.pi / 2 * total) ** 2, mask=np.ones_like(real.mask))


def thirty_db(*_: object) -> Any:
    """30 dB, whatever is seen."""
    return SimpleNamespace(psnr_db=30.0)


def no_operator(eye: Any, stack: PanelStack, *, width_px: int, height_px: int, fov_deg: float) -> EyeOperator:
    """The rays that count, and weights of zero."""
    real = eye_operator(eye, stack, width_px=width_px, height_px=height_px, fov_deg=fov_deg)
    return EyeOperator(tuple(matrix * 0 for matrix in real.panels), real.mask)


def grey_layers(problem: solve.Problem) -> F32:
    """(N, h, w, C) every panel half way."""
    return np.full((problem.stack.count, solve.HEIGHT_PX, solve.WIDTH_PX, 3), 0.5, np.float32)


def one_eye(problem: solve.Problem) -> F32:
    """(N, h, w, C) the left eye's picture alone, as well as it can be shown."""
    return conjugate_gradients(problem.operators[:1], problem.wanted[:1], problem.stack, iterations=30)


def grey_network(model: str, images: Sequence[U8], eyes_m: F64, stack: PanelStack) -> U8:
    """(N, h, w, 3) every panel half way, whatever is wanted."""
    return np.full((stack.count, stack.height_px, stack.width_px, 3), 128, np.uint8)


def mean_network(model: str, images: Sequence[U8], eyes_m: F64, stack: PanelStack) -> U8:
    """(N, h, w, 3) the mean of the warped targets: nothing of the difference between the eyes."""
    wanted = [as_intensity(image) for image in images]
    return as_codes(mean_of_targets(eyes_m, wanted, stack, fov_deg=networks.FOV_DEG))


def one_place_network(model: str, images: Sequence[U8], eyes_m: F64, stack: PanelStack) -> U8:
    """(N, h, w, 3) what eyes straight ahead should be shown, wherever the eyes are."""
    return networks.predicted(model, images, eyes_at(distance_m=0.6), stack)


def even_answer(model: str, need: F64, doubt: uncertainty.Doubt) -> F64:
    """Both outer panels half way, whatever is wanted."""
    cell = 2 * uncertainty.loaded(model).session.contract.cell_px
    return np.full((2, len(need), need.shape[1] + cell), 0.5)


def even_panels(model: str, sigma_mm: float, separation_m: float = 0.062) -> U8:
    """The same as layers."""
    return np.full((3, uncertainty.STACK.height_px, uncertainty.STACK.width_px, 3), 128, np.uint8)


def sure_answer(model: str, need: F64, doubt: uncertainty.Doubt) -> F64:
    """What eyes that are exactly known would be shown."""
    return uncertainty.answer_of(model, need, (0.0, 0.0, doubt[2]))


def sure_panels(model: str, sigma_mm: float, separation_m: float = 0.062) -> U8:
    """The same as layers."""
    return uncertainty.layers_of(model, 0.0, separation_m)


class FirstSample:
    """A tracker that repeats its first sample for ever."""

    def __init__(self, *_: object) -> None:
        self._eyes: F64 | None = None

    def update(self, eyes: Any, *, capture_ns: int) -> None:
        self._eyes = eyes.eyes_m if self._eyes is None else self._eyes

    def at(self, time_ns: int) -> Any:
        return SimpleNamespace(eyes_m=self._eyes, label="exact")


class Nobody(FirstSample):
    """A tracker that never sees anybody."""

    def at(self, time_ns: int) -> Any:
        return SimpleNamespace(eyes_m=None, label="none")


def first_place(places: F64, dt_s: float, *, q: float, noise_m: float) -> tuple[Any, Any]:
    """A filter that believes its first place and no other."""
    return places[0], np.zeros(3)


def by_centres(sensor_m: F64, stack_m: F64) -> F64:
    """(4, 4) a shift alone, of the middles on each other."""
    matrix = np.eye(4)
    matrix[:3, 3] = stack_m.mean(0) - sensor_m.mean(0)
    return matrix


def without_shift(fit: Fit, sensor_m: F64, stack_m: F64) -> F64:
    """(4, 4) the right turn and scale, and no shift."""
    matrix = fit(sensor_m, stack_m)
    matrix[:3, 3] = 0
    return matrix


def controls(fits: Mapping[str, Fit]) -> Iterator[Control]:
    """Every impostor, stage by stage."""

    def solved_by(method: solve.Method) -> tuple[tuple[str, solve.Method], ...]:
        names = ("CG-30", *networks.MODELS, "sart")  # not in its own place: the mean of targets is an impostor
        return tuple((name, method) for name in names)

    refuser = poses.Poses(nothing, nothing, nothing, nothing, nothing)
    bent = poses.Poses(first_pose, straight_projection, unmoved, grey_retina, unwarped)
    yield Control(poses.STAGE, "refuses everything", partial(poses.trials, refuser))
    yield Control(poses.STAGE, "always straight ahead", partial(poses.trials, bent))
    flat = rpu.Rpu(unwarped, unwarped, unwarped, central_positions)
    yield Control(rpu.STAGE, "refuses everything", partial(rpu.trials, rpu.Rpu(nothing, nothing, nothing, nothing)))
    yield Control(rpu.STAGE, "no perspective", partial(rpu.trials, flat))
    linear = phases.Malus(no_wave, no_wave, lambda angles: float(np.sum(angles)))
    yield Control(phases.PHASE, "no wave", partial(_of_stage, phases.PHASE, partial(phases.trials, linear)))
    yield Control(phases.JONES, "no wave", partial(_of_stage, phases.JONES, partial(phases.trials, linear)))
    grey = retina.Eyesight(grey_retina, thirty_db, lambda squared: 30.0)
    yield Control(retina.STAGE, "grey, and 30 dB", partial(retina.trials, grey))
    yield Control(
        retina.STAGE, "no parallax", partial(retina.trials, retina.Eyesight(flat_retina, thirty_db, lambda _: 30.0))
    )
    zero = partial(solve.trials, solve.Solvers(no_operator, ()))
    yield Control(solve.STAGE, "an operator of zeros", zero)
    for name, method in (("grey layers", grey_layers), ("one eye alone", one_eye), ("mean of targets", solve.mean)):
        yield Control(
            solve.STAGE, name, partial(_recorded, partial(solve.trials, solve.Solvers(methods=solved_by(method))))
        )
    for name, predict in (("grey layers", grey_network), ("mean of targets", mean_network)):
        yield Control(networks.STAGE, name, partial(networks.picture_trials, predict))
    unmoving = partial(networks.picture_trials, one_place_network)
    yield Control(networks.STAGE, "eyes always straight ahead", partial(_elsewhere, unmoving))
    yield Control(uncertainty.STAGE, "even panels", partial(uncertainty.trials, even_answer, even_panels))
    sure = partial(uncertainty.trials, sure_answer, sure_panels)
    yield Control(uncertainty.STAGE, "never in doubt", partial(_doubtful, sure))
    for name, make in (("repeats its first sample", FirstSample), ("never sees anybody", Nobody)):
        yield Control(tracking.STAGE, name, partial(tracking.trials, tracking.Tracking(make, first_place)))
    yield Control(calibration.STAGE, "a shift alone", partial(calibration.trials, dict.fromkeys(fits, by_centres)))
    unshifted = {rule: partial(without_shift, fit) for rule, fit in fits.items()}
    yield Control(calibration.STAGE, "no shift", partial(calibration.trials, unshifted))
    swapped = dict(zip(fits, [*list(fits.values())[1:], next(iter(fits.values()))], strict=True))
    yield Control(calibration.STAGE, "each rule another's", partial(_noisy, partial(calibration.trials, swapped)))


def _of_stage(stage: str, make: Callable[[], Iterable[Trial]]) -> Iterator[Trial]:
    return (trial for trial in make() if trial.stage == stage)


def _recorded(make: Callable[[], Iterable[Trial]]) -> Iterator[Trial]:
    """The cases in which a method plays a part."""
    return (trial for trial in make() if trial.recorded)


def _doubtful(make: Callable[[], Iterable[Trial]]) -> Iterator[Trial]:
    """The cases in which doubt is large enough to be felt."""
    columns = tuple(f"doubt of {value} columns" for value in (1, 6, 100))
    off = tuple(f"off by {value} mm" for value in (1, 2, 4, 10, 50))
    felt = (*columns, *off, "to 50 columns", "NaN doubt", "infinite doubt")
    return (trial for trial in make() if trial.name.endswith(felt))


def _elsewhere(make: Callable[[], Iterable[Trial]]) -> Iterator[Trial]:
    """The cases in which eyes are not straight ahead."""
    return (trial for trial in make() if networks.FROM in trial.name)


def _noisy(make: Callable[[], Iterable[Trial]]) -> Iterator[Trial]:
    """The cases with noise: without it all rules are one."""
    return (trial for trial in make() if "noise" in trial.name or "decimetres" in trial.name)
