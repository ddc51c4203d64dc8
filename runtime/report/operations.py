"""Multiply-adds of one prediction: counted, not measured, so that they hold on any machine.

One is a product added to a sum. Elementwise arithmetic (a sum, a product, a limit, a table, a root) counts as one per
value written; moving and rounding count as none. A bilinear sample is four per channel, a bicubic one sixteen.
Networks are counted from the shapes that onnxruntime meets when it runs their graph unoptimised; what surrounds
them and the reference methods by the formulas below, per pixel.
"""

from __future__ import annotations

import json
import tempfile
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from math import log2, prod
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from runtime.errors import InputError
from runtime.model.chain import chain_frame
from runtime.model.contract import Contract
from runtime.model.predictor import Predictor
from runtime.model.pyramid_level import CENTRE, OUTER
from runtime.model.schedule import Picture, Problem, carry_on, carry_out
from runtime.model.visible import visible_boxes
from runtime.optics.stack import PanelStack
from runtime.records import F64, I16, U8
from runtime.report.pairs import StillPair

if TYPE_CHECKING:
    from runtime.model.network import NetworkPredictor
    from runtime.model.session import ModelSession
    from runtime.model.unrolled import UnrolledPredictor

RGB, RGBA, EYES = 3, 4, 2
LINEAR, CUBIC = 4, 16  # products per sample
FINER = 4 * 8 + LINEAR  # of a picture made twice as fine, by two passes of a cubic kernel
NOTHING: I16 = np.empty((0, 0), np.int16)
Shape = tuple[int, ...]

COUNTED_ONCE = (
    *("Abs", "Add", "Clip", "Cos", "Div", "Erf", "Exp", "HardSigmoid", "LeakyRelu", "Log", "Max", "Min", "Mul", "Neg"),
    *("Pow", "Reciprocal", "Relu", "Sigmoid", "Sin", "Softplus", "Sqrt", "Sub", "Tanh"),
)


def node_multiply_adds(kind: str, inputs: Sequence[Shape], output: Shape) -> int:
    """Of one ONNX node, by the shapes of its inputs and its first output."""
    written = prod(output)
    if kind == "Conv":  # weights (out, in / groups, *kernel)
        return written * prod(inputs[1][1:])
    if kind == "ConvTranspose":  # weights (in, out / groups, *kernel)
        return prod(inputs[0]) * prod(inputs[1][1:])
    if kind == "MatMul":
        return written * inputs[0][-1]
    if kind == "Gemm":
        return written * (prod(inputs[0]) // output[0])
    if kind == "Resize":
        return written * LINEAR
    if kind in ("MaxPool", "AveragePool", "GlobalAveragePool", "ReduceMean", "ReduceSum", "BatchNormalization"):
        return prod(inputs[0])
    return written if kind in COUNTED_ONCE else 0


def graph_multiply_adds(path: Path, shapes: Sequence[Shape]) -> int:
    """Of one run of an ONNX file on inputs of these shapes, in its order. Raises InputError: no such run."""
    from runtime.model.onnx_runtime import onnxruntime
    from runtime.model.session import TYPES

    ort = onnxruntime()

    options = ort.SessionOptions()
    options.graph_optimization_level = ort.GraphOptimizationLevel.ORT_DISABLE_ALL
    options.add_session_config_entry("session.disable_prepacking", "1")  # packed weights have no shape
    options.enable_profiling = True
    options.log_severity_level = 3
    with tempfile.TemporaryDirectory() as folder:
        options.profile_file_prefix = str(Path(folder) / "run")
        try:
            session = ort.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
            inputs = zip(session.get_inputs(), shapes, strict=True)
            session.run(None, {item.name: np.zeros(shape, TYPES[item.type]) for item, shape in inputs})
        except Exception as error:  # onnxruntime raises its own hierarchy of undocumented exceptions
            raise InputError(path, "", f"does not run ({(str(error).splitlines() or [''])[0][:120]})") from None
        events = json.loads(Path(session.end_profiling()).read_text(encoding="utf-8"))
    nodes = [e["args"] for e in events if e.get("cat") == "Node" and e["name"].endswith("_kernel_time")]
    return sum(
        node_multiply_adds(node["op_name"], _shapes(node["input_type_shape"]), _shapes(node["output_type_shape"])[0])
        for node in nodes
        if node["output_type_shape"]
    )


def _shapes(entries: Sequence[Mapping[str, Sequence[int]]]) -> list[Shape]:
    return [tuple(shape) for entry in entries for shape in entry.values()]


def predictor_multiply_adds(predictor: Predictor, pair: StillPair, *, path: Path | None) -> int:
    """Of a whole prediction from a pair's two pictures, warps included. path: the network's file, if it has one.

    Predicts once, to see on which shapes the network is run, and how often.
    """
    from runtime.model.network import NetworkPredictor
    from runtime.model.sart import SartPredictor
    from runtime.model.unrolled import UnrolledPredictor
    from runtime.plan.reduced import ReducedPredictor

    if isinstance(predictor, ReducedPredictor):
        enlarged = LINEAR * RGBA * predictor.stack.count * _pixels(predictor.stack)
        return predictor_multiply_adds(predictor.small, pair, path=path) + enlarged
    windows = predictor.windows(pair.eyes_m)
    drawn = sum((rows.stop - rows.start) * (columns.stop - columns.start) for rows, columns in windows)
    total: int = EYES * RGBA * drawn * (LINEAR if predictor.interpolation == "linear" else FINER)
    if isinstance(predictor, SartPredictor):
        return total + sart_multiply_adds(predictor.stack, iterations=predictor.iterations)
    if path is None:
        raise ValueError("a network's file is needed to count it")
    if isinstance(predictor, UnrolledPredictor):
        total += correction_multiply_adds(predictor.session.contract, predictor.stack, pair.eyes_m)
    elif isinstance(predictor, NetworkPredictor):
        values = (len(windows) * EYES + predictor.stack.count) * RGB  # a table in, a limit out
        total += values * _pixels(predictor.stack)
    else:
        raise ValueError(f"{type(predictor).__name__} can't be counted")
    runs = Counter(_network_runs(predictor, pair))
    return total + sum(times * graph_multiply_adds(path, shapes) for shapes, times in runs.items())


class _Noting:
    """A session that notes the shapes of its inputs, run by run."""

    def __init__(self, session: ModelSession) -> None:
        self._session = session
        self.shapes: list[tuple[Shape, ...]] = []

    def run(self, feeds: Mapping[str, NDArray[Any]], shapes: Mapping[str, Shape]) -> dict[str, NDArray[Any]]:
        self.shapes.append(tuple(feeds[name].shape for name in self._session.input_shapes))
        return self._session.run(feeds, shapes)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._session, name)


def _network_runs(predictor: UnrolledPredictor | NetworkPredictor, pair: StillPair) -> list[tuple[Shape, ...]]:
    """The shapes of the network's inputs at each of its runs in one prediction."""
    from runtime.model.still import solve_still

    session = predictor.session
    noting = _Noting(session)
    predictor.session = noting  # type: ignore[assignment]
    try:
        solve_still(*pair.images, eyes_m=pair.eyes_m, fov_deg=pair.fov_deg, predictor=predictor)
    finally:
        predictor.session = session
    return noting.shapes


def correction_multiply_adds(contract: Contract, stack: PanelStack, eyes_m: F64) -> int:
    """What a chain model does outside its network, over what both eyes look through: its schedule, counted."""
    counted = _CountedSurround(contract, stack, eyes_m)
    carry_out(contract.steps, counted, lambda pictures: dict.fromkeys(OUTER, NOTHING))
    if contract.refining:
        # Along each of a picture's rays three layers, sin² and what lacks; brought back to the panel's pixels.
        counted.total += EYES * RGB * _pixels(stack) * (stack.count * LINEAR + 2 + LINEAR + 1)
        counted.prepare()
        carry_on(contract.steps[-contract.refining :], counted)
    return counted.total


class _CountedSurround:
    """Carries out nothing, and counts what each call of the schedule would cost."""

    def __init__(self, contract: Contract, stack: PanelStack, eyes_m: F64) -> None:
        self._boxes = visible_boxes(eyes_m, stack)
        self._reduction: int = contract.reduction
        self._level: int = contract.steps[0].reduction
        frame = chain_frame(eyes_m, stack, cell_px=contract.cell_px, reduction=contract.reduction)
        self._in_frame = RGB * frame.rows * frame.width_px
        self._even = True  # no panel was changed yet
        self._sharpened = 6 if contract.emphasis else 0  # a separable filter of three
        self.total = 0
        self.prepare()

    def prepare(self) -> None:
        """Both eyes' pictures, sharpened and looked up."""
        self.total += EYES * self._values(CENTRE, 1) * (self._sharpened + 1)

    def begin(
        self, pictures: Sequence[Picture], problem: Problem, *, again: bool = False
    ) -> AbstractContextManager[None]:
        return nullcontext()

    def network_pictures(self) -> tuple[I16, I16]:
        self._residual()
        # Every value goes into one mean.
        coarser = EYES * self._values(CENTRE, 1 if self._reduction == 1 else self._level)
        self.total += coarser + self._in_frame * (EYES * LINEAR + 2)
        return NOTHING, NOTHING

    def set_panel(self, reduction: int, panel: int, codes: I16, *, shown: bool) -> None:
        self.total += (CUBIC + 2) * self._values(panel, reduction)

    def project(self, reduction: int, panels: Sequence[int]) -> None:
        self.total += len(panels) * EYES * LINEAR * self._values(CENTRE, reduction)

    def correct(self, reduction: int, panel: int, *, size: float, shown: bool) -> None:
        self._residual()
        self.total += (EYES * LINEAR + 4) * self._values(panel, reduction)

    def upsample(self, coarser_reduction: int, reduction: int, *, shown: bool) -> None:
        self._level = reduction
        self.total += sum(CUBIC * self._values(n, reduction) for n in OUTER)

    def finish(self) -> U8:
        self.total += 7 * self._values(CENTRE, 1)  # the centre: two targets less four, and a limit
        return np.empty((0, 0, 0, 4), np.uint8)

    def close(self) -> None:
        pass

    def _residual(self) -> None:
        """What each eye lacks when the centre is closed: two differences each, mean, limit, two differences."""
        self.total += 0 if self._even else 8 * self._values(CENTRE, self._level)
        self._even = False

    def _values(self, panel: int, reduction: int) -> int:
        box = self._boxes[panel]
        return RGB * (box.width_px // reduction) * (box.height_px // reduction)


def sart_multiply_adds(stack: PanelStack, *, iterations: int) -> int:
    """Each eye in turn samples every panel, and every panel that eye's lack: five per value each way, and a limit."""
    values = RGB * _pixels(stack)
    return EYES * values + iterations * EYES * stack.count * (LINEAR + 1 + LINEAR + 2) * values


def cg_multiply_adds(stack: PanelStack, *, rays: int, iterations: int) -> int:
    """Least squares by conjugate gradients: operator, its transpose and the check of the clipped iterate a turn.

    rays: counted rays of both eyes together. The vectors' updates and squares are one per value each.
    """
    sampled = stack.count * LINEAR * rays * RGB
    unknowns = stack.count * RGB * _pixels(stack)
    start = 3 * sampled + RGB * rays + unknowns
    return start + iterations * (3 * sampled + 4 * RGB * rays + 5 * unknowns)


def mean_multiply_adds(stack: PanelStack) -> int:
    """Each eye's phases sampled on to every panel and added; one table per picture; a share and a limit."""
    values = RGB * _pixels(stack)
    return EYES * values + stack.count * (EYES * (LINEAR + 1) + 2) * values


def filter_multiply_adds(stack: PanelStack, *, steps: int) -> int:
    """Fourier transforms at 2.5·n·log2(n) per real picture (margins left out), and per frequency the small solve.

    A complex product is four. Per step: every panel seen by both eyes, five transforms, the solve, every panel
    sampled from its answer.
    """
    pixels = _pixels(stack)
    transforms = (EYES + stack.count) * RGB * round(2.5 * pixels * log2(pixels))
    solve = (EYES * 8 + stack.count * EYES * 4) * RGB * pixels // 2  # half the frequencies: the pictures are real
    samples = (EYES + 1) * stack.count * (LINEAR + 1) * RGB * pixels
    return EYES * (LINEAR + 1) * RGB * pixels + steps * (transforms + solve + samples)


def _pixels(stack: PanelStack) -> int:
    return stack.width_px * stack.height_px


def spoken(count: float) -> str:
    """A count as billions, in a column's width: `0.43`, `12`, `5,310`."""
    billions = count / 1e9
    return f"{billions:#.2g}" if billions < 10 else f"{billions:,.0f}"
