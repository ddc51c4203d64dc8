"""The steps around the network as passes of fragment shaders, and the images that live from frame to frame.

Images are signed 16-bit sixteenths of a code, as OpenCV's are: one number a pixel where there is one channel, else
four, of which one is unused (three can't be drawn into). What the eyes want is held as 8-bit codes. Only the network's
raster, its answer and, where they are asked for, the layers cross the bus.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from math import ceil
from typing import Any

import cv2
import moderngl
import numpy as np
from numpy.typing import NDArray

from runtime.errors import InputError, ModelFailure
from runtime.model.chain import ColumnLaw
from runtime.model.contract import Contract
from runtime.model.fade import CORRECTED_SHARE
from runtime.model.gl.assembly import left_in
from runtime.model.gl.programs import Image, Passes
from runtime.model.job import Picture
from runtime.model.reprojection import CENTRE, FRONT, NEUTRAL, OUTER, REAR, START, coarser, reprojection, spreads
from runtime.model.steps import Problem
from runtime.model.targets import phase_codes
from runtime.optics.stack import PanelStack, PlaneRaster
from runtime.records import F64, I16, U8, Layers
from runtime.support.gl import DrawnPicture, finish
from runtime.support.gl_sharing import LayerPool, wait_until_drawn

EYES = ("left", "right")
NAMES = {REAR: "rear", FRONT: "front"}
KERNEL = 64  # entries of the blur's uniform
SURE = (0.0, 0.0)  # a spread, pixels

Spread = dict[int, tuple[float, float]]


class GlState:
    """A `SolverState`. Used on the thread of its context, which is current whenever a frame begins."""

    def __init__(
        self,
        passes: Passes,
        contract: Contract,
        stack: PanelStack,
        *,
        pool: LayerPool | None = None,
    ) -> None:
        """passes: of a context that others may use too. pool: where solutions are left; None: they are read back.
        Raises InputError where a panel is too large for the driver."""
        check_size(passes.context, stack)
        self._passes, self._contract, self._stack = passes, contract, stack
        self._textures: dict[tuple[Any, ...], Any] = {}
        table = phase_codes(contract.branch).reshape(256, -1)[:, 0].astype(np.int16)
        self._table = Image(self._texture("table", 256, 1, 1, data=table), 256, 1)
        self._pool = pool
        self._layers: U8 | None = None  # where they are read back
        self._read: dict[tuple[int, ...], tuple[I16, I16]] = {}
        self._closed = False
        self._outer: dict[int, str] = {}  # which of two images a panel is in

    @contextmanager
    def begin(self, pictures: Sequence[Picture], problem: Problem) -> Iterator[None]:
        with self._passes.drawing():
            self._problem = problem
            self._grey = problem.channels == 1
            self._rasters, self._reduction = problem.rasters, 1
            self._outer = {}
            taken = self._taken(pictures)
            self._want(taken, self._wanted())
            self._want(taken, self._reduced())
            self._reduction, self._mean_in = problem.reduction, "mean"
            self._rasters = problem.coarser_rasters(self._reduction)
            how: Any = {"eye_sigma_mm": problem.eye_sigma_mm, "reduction": self._reduction}
            self._spread: Spread = spreads(self._rasters, problem.eyes_m, **how)
            yield

    def network_pictures(self) -> tuple[I16, I16]:
        problem, frame = self._problem, self._problem.frame
        seen = tuple(self._grown(f"network {side}", frame.width_px, frame.rows) for side in EYES)
        matrices = [problem.reduced_from_frame(side) for side in range(2)]
        self._draw(
            "network",
            seen,
            self._reduced(),
            {
                "size": problem.reduced_size,
                "left_from_raster": _mat3(matrices[0]),
                "right_from_raster": _mat3(matrices[1]),
                **_columns(frame.columns),
            },
        )
        return self._read_back(seen)

    def set_panel(self, panel: int, codes: I16, *, shown: bool) -> None:
        rows, columns = codes.shape[:2]
        answer = self._grown(f"answer {panel}", columns, rows, components=self._problem.channels)
        answer.texture.write(np.ascontiguousarray(codes), viewport=(0, 0, columns, rows), alignment=1)
        raster = coarser(self._problem.rasters[panel], self._contract.reduction)  # as the processor does it
        spare = self._spare(panel)
        coarse = spare if self._reduction > 1 else self._coarse(("answer", panel), _size(raster), dtype="i2")
        matrix = self._problem.answer_from_raster(panel, raster)
        place = {"size": answer.size, "image_from_panel": _mat3(matrix), **_columns(self._problem.answer_columns)}
        self._draw("resample", (coarse,), {"image": answer}, {**place, "shown": False})
        if self._reduction == 1:
            self._finer(coarse, spare, shown=shown)
        self._swap(panel)

    def project(self, panels: Sequence[int]) -> None:
        for n in panels:
            if n in self._spread:
                half, mean = self._image(n, "half"), self._image(n, "mean")
                self._blur({"image": self._panel(n)}, (half,), self._spread[n])
                self._blur({"image": half}, (mean,), self._spread[n], down=True)

    def correct(self, panel: int, *, size: float, shown: bool) -> None:
        places: dict[str, Any] = {
            f"centre_from_{eye}": _mat3(reprojection(self._problem.stack, self._rasters, eye_m, of=CENTRE, on=panel))
            for eye, eye_m in zip(EYES, self._problem.eyes_m, strict=True)
        }
        places["size"] = _size(self._rasters[CENTRE])
        result, outer = (self._spare(panel),), {"panel": self._panel(panel)}
        how = {"share": size, "shown": shown}
        if spread := self._spread:
            outer["mean"] = self._mean(panel)
            half = self._joined(panel, outer, places, spread.get(panel, SURE))
            kernel = {**_kernel(spread.get(panel, SURE), down=True), "size": half.size}
            self._draw("correct_unsure", result, {**outer, "half_blurred": half}, {**how, **kernel})
        else:
            images, seen = self._seen()
            lacks = {eye: self._image(CENTRE, f"lacks {eye}") for eye in EYES}
            self._draw("residual", tuple(lacks.values()), images, seen)
            self._draw("correct", result, {**lacks, **outer, **self._wanted()}, {**places, **how})
        self._swap(panel)

    def finish(self) -> Layers:
        self._whole()
        width, height = self._stack.width_px, self._stack.height_px
        if self._pool is not None:
            left = left_in(self._pool, self._passes, self._stack)
            self._draw_layers(tuple(Image(texture, width, height) for texture in left.textures))
            wait_until_drawn()
            return left
        images = tuple(
            Image(self._texture(("layer", n), width, height, 4, dtype="f1"), width, height) for n in range(3)
        )
        self._draw_layers(images)
        finish()
        if self._layers is None:
            self._layers = np.empty((3, height, width, 4), np.uint8)
        for image, layer in zip(images, self._layers, strict=True):
            self._passes.target((image,)).read_into(layer, components=4)
        return self._layers

    def close(self) -> None:
        if not self._closed:
            self._closed = True
            with suppress(Exception):  # of a context that is lost there is nothing to release
                for texture in self._textures.values():
                    self._passes.forget(texture)
            self._textures = {}

    def _whole(self) -> None:
        """Go on with the panels on their own pixels."""
        if self._reduction == 1:
            return
        coarse = {n: (self._panel(n), self._mean(n)) for n in OUTER}
        self._reduction, self._rasters, self._mean_in = 1, self._problem.rasters, "half"
        for n, (panel, mean) in coarse.items():
            self._finer(panel, self._spare(n), shown=True)
            self._finer(mean, self._mean(n), shown=False)
            self._swap(n)

    def _finer(self, coarse: Image, fine: Image, *, shown: bool) -> None:
        scale = (coarse.width_px / fine.width_px, coarse.height_px / fine.height_px)
        how = {"size": coarse.size, "image_from_panel": scale, "shown": shown}
        self._draw("finer", (fine,), {"image": coarse}, how)

    def _draw_layers(self, images: tuple[Image, ...]) -> None:
        """The solution: one image a panel, RGBA in 8 bits."""
        boxes = self._problem.boxes
        outer = {NAMES[n]: self._panel(n) for n in OUTER} | {f"{NAMES[n]}_mean": self._mean(n) for n in OUTER}
        where: dict[str, Any] = {
            f"{name}_origin": (boxes[n].u0, boxes[n].v0) for n, name in ((CENTRE, "centre"), *NAMES.items())
        }
        where["centre_size"] = _size(self._rasters[CENTRE])
        self._draw(
            "close",
            images,
            {**self._wanted(), **outer},
            {**self._through(), **where, "neutral": NEUTRAL},
        )

    def _taken(self, pictures: Sequence[Picture]) -> list[Image]:
        """The pictures where they were drawn, or their box, uploaded."""
        box = self._problem.boxes[CENTRE]
        taken = []
        self._origin = (0, 0)
        for eye, picture in zip(EYES, pictures, strict=True):
            if isinstance(picture, DrawnPicture):
                self._origin = (box.u0, box.v0)
                taken.append(Image(picture.texture, box.width_px, box.height_px))
                continue
            texture = self._texture(("picture", eye), self._stack.width_px, self._stack.height_px, 4, dtype="f1")
            image = Image(texture, box.width_px, box.height_px)
            texture.write(np.ascontiguousarray(picture[box.slices]), viewport=(0, 0, *image.size))
            taken.append(image)
        return taken

    def _want(self, pictures: Sequence[Image], wanted: dict[str, Image]) -> None:
        """What both eyes want, into images that may be coarser than the box."""
        box, left, right = self._problem.boxes[CENTRE], wanted["wanted_left"], wanted["wanted_right"]
        reduction = (box.width_px / left.width_px, box.height_px / left.height_px)
        how = {"origin": self._origin, "box": (box.width_px, box.height_px), "emphasis": self._contract.emphasis}
        self._draw(
            "wanted", (left, right), {"left": pictures[0], "right": pictures[1]}, {**how, "reduction": reduction}
        )

    def _joined(
        self,
        panel: int,
        outer: dict[str, Image],
        places: dict[str, Any],
        spread: tuple[float, float],
    ) -> Image:
        """What a correction for unsure eyes blurs, blurred across.

        The mean B of what is lacked, less twice the noise p - B m of a panel p with mean m = B p, is
        B(lacks + 2 (m - p)) + 2 (m - p): one blur for two, of numbers that are small.
        """
        lacks, moving, half = (
            tuple(self._image(CENTRE, f"{name} {eye}") for eye in EYES) for name in ("lacks", "moving", "half")
        )
        images, seen = self._seen()
        self._draw("residual_unsure", (*lacks, *moving), images, {**seen, "of_front": panel == REAR})
        self._blur({"first": moving[0], "second": moving[1]}, half, spread, name="blur_both", twice=True)
        joined, blurred = (self._image(panel, name) for name in ("joined", "half"))
        lacked = dict(zip((*EYES, *(f"half_blurred_{eye}" for eye in EYES)), (*lacks, *half), strict=True))
        lacked |= self._wanted()
        self._draw("back", (joined,), {**lacked, **outer}, {**places, **_kernel(spread, twice=True, down=True)})
        self._blur({"image": joined}, (blurred,), spread)
        return blurred

    def _seen(self) -> tuple[dict[str, Image], dict[str, Any]]:
        """What the eyes want and see at the centre panel's pixels."""
        means = {NAMES[n]: self._mean(n) for n in OUTER}
        return {**self._wanted(), **means}, {**self._through(), **self._fade()}

    def _through(self) -> dict[str, Any]:
        """How the eyes see the outer panels through the centre panel's pixels."""
        rasters = self._rasters
        found: dict[str, Any] = {}
        for n, name in NAMES.items():
            found[f"{name}_size"] = _size(rasters[n])
            for eye, eye_m in zip(EYES, self._problem.eyes_m, strict=True):
                found[f"{name}_from_{eye}"] = _mat3(reprojection(self._problem.stack, rasters, eye_m, of=n, on=CENTRE))
        return found

    def _fade(self) -> dict[str, Any]:
        fade = self._problem.fade
        if fade is None:
            return {"over": (0.0, 0.0, 0.0, 0.0)}
        along, down = (float(over_px * CORRECTED_SHARE) for over_px in fade.over_px)
        raster = self._rasters[CENTRE]
        matrix = self._problem.centre_from(raster.plane_from_raster())
        return {
            "kept_box": tuple(map(float, (fade.kept.u0, fade.kept.v0, fade.kept.u1, fade.kept.v1))),
            "over": (along * fade.left, down * fade.top, along * fade.right, down * fade.bottom),
            "centre_from_here": (matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]),
        }

    def _blur(
        self,
        images: dict[str, Image],
        outputs: tuple[Image, ...],
        spread: tuple[float, float],
        *,
        name: str = "blur",
        down: bool = False,
        twice: bool = False,
    ) -> None:
        kernel = _kernel(spread, down=down, twice=twice)
        self._draw(name, outputs, images, {**kernel, "size": outputs[0].size})

    def _draw(
        self, name: str, outputs: tuple[Image, ...], inputs: dict[str, Image], uniforms: Mapping[str, Any]
    ) -> None:
        always = {"even": START, "grey": self._grey}
        self._passes.draw(name, outputs, inputs, {**uniforms, **always})

    def _wanted(self) -> dict[str, Image]:
        """What the eyes want, with the table that makes phase sums of it."""
        if self._reduction > 1:
            return self._reduced()
        images = {f"wanted_{eye}": self._image(CENTRE, f"wanted {eye}", dtype="f1") for eye in EYES}
        return {**images, "table": self._table}

    def _reduced(self) -> dict[str, Image]:
        """The same as coarse as the network's pictures are taken from it."""
        size = self._problem.reduced_size
        images = {f"wanted_{eye}": self._coarse(("reduced", eye), size, dtype="f1") for eye in EYES}
        return {**images, "table": self._table}

    def _coarse(self, key: tuple[str, Any], size: tuple[int, int], *, dtype: str) -> Image:
        """An image of the model's coarser raster."""
        width, height = (-(-px // self._contract.reduction) for px in (self._stack.width_px, self._stack.height_px))
        components = 1 if self._grey else 4
        return Image(self._texture(key, width, height, components, dtype=dtype), *size)

    def _mean(self, panel: int) -> Image:
        """An outer panel as eyes that are unsure see it."""
        return self._image(panel, self._mean_in) if panel in self._spread else self._panel(panel)

    def _panel(self, panel: int) -> Image:
        return self._image(panel, self._outer.get(panel, "outer"))

    def _spare(self, panel: int) -> Image:
        """Where a panel is drawn that is made from itself."""
        return self._image(panel, _other(self._outer.get(panel, "outer")))

    def _swap(self, panel: int) -> None:
        self._outer[panel] = _other(self._outer.get(panel, "outer"))

    def _image(self, panel: int, name: str, *, dtype: str = "i2") -> Image:
        """The box's part of an image as large as a whole panel: boxes follow the viewer, textures don't."""
        components = 1 if self._grey else 4
        size = self._stack.width_px, self._stack.height_px
        return Image(self._texture((name, panel), *size, components, dtype=dtype), *_size(self._rasters[panel]))

    def _grown(self, name: str, width_px: int, height_px: int, *, components: int | None = None) -> Image:
        """An image of the network's raster, whose size follows the viewer; its texture only grows."""
        components = components or (1 if self._grey else 4)
        held = self._textures.get(key := (name, components, "i2"))
        if held is None or held.width < width_px or held.height < height_px:
            width, height = (max(width_px, held.width), max(height_px, held.height)) if held else (width_px, height_px)
            check_raster(self._passes.context, width, height)
            if held is not None:
                self._passes.forget(self._textures.pop(key))
            held = self._texture(name, width, height, components)
        return Image(held, width_px, height_px)

    def _texture(
        self, key: Any, width: int, height: int, components: int, *, dtype: str = "i2", data: NDArray[Any] | None = None
    ) -> Any:
        key = (key, components, dtype)
        if key not in self._textures:
            made = self._passes.context.texture((width, height), components, data, dtype=dtype, alignment=1)
            made.filter = (moderngl.NEAREST, moderngl.NEAREST)
            made.repeat_x = made.repeat_y = False
            self._textures[key] = made
        return self._textures[key]

    def _read_back(self, seen: Sequence[Image]) -> tuple[I16, I16]:
        """The one thing that crosses to the processor: the network's raster."""
        finish()
        channels, (width, height) = self._problem.channels, seen[0].size
        tail = () if channels == 1 else (channels,)
        if (key := (height, width, channels)) not in self._read:
            self._read = {key: (np.empty((height, width, *tail), np.int16), np.empty((height, width, *tail), np.int16))}
        for index, array in enumerate(self._read[key]):
            self._passes.target(seen).read_into(
                array, viewport=(0, 0, width, height), components=channels, attachment=index, alignment=1, dtype="i2"
            )
        return self._read[key]


def check_size(context: moderngl.Context, stack: PanelStack) -> None:
    """Raises InputError where a panel is wider or higher than the driver allows."""
    most = int(context.info["GL_MAX_TEXTURE_SIZE"])
    most_wide, most_high = (min(most, int(value)) for value in context.info["GL_MAX_VIEWPORT_DIMS"])
    for name, value, limit in (("width_px", stack.width_px, most_wide), ("height_px", stack.height_px, most_high)):
        if value > limit:
            raise InputError("stack", name, f'{value}: this OpenGL driver allows {limit}; set model.backend = "cpu"')


def check_raster(context: moderngl.Context, width_px: int, height_px: int) -> None:
    """Raises ModelFailure where the network's raster is larger than the driver allows."""
    most = int(context.info["GL_MAX_TEXTURE_SIZE"])
    if max(width_px, height_px) > most:
        raise ModelFailure(f"OpenGL: the network's raster is {width_px}x{height_px}, the driver allows {most}")


def _other(name: str) -> str:
    return "outer" if name == "spare" else "spare"


def _kernel(spread: tuple[float, float], *, down: bool = False, twice: bool = False) -> dict[str, Any]:
    """The mean over where the eyes may be, as pixels move by it, along one direction."""
    u, v = (s * np.sqrt(2.0) if twice else s for s in spread)
    reach, weights = ceil(3 * max(u, v)), [1.0]
    if reach:
        weights = cv2.getGaussianKernel(2 * reach + 1, v if down else u)[reach:, 0].tolist()
    padded = tuple(weights) + (0.0,) * (KERNEL - len(weights))
    return {"kernel": padded, "reach": reach, "along": (0, 1) if down else (1, 0)}


def _size(raster: PlaneRaster) -> tuple[int, int]:
    return raster.width_px, raster.height_px


def _columns(law: ColumnLaw) -> dict[str, float]:
    return {"bend": law.bend, "middle": law.middle}


def _mat3(matrix: F64) -> tuple[float, ...]:
    """Column by column, as OpenGL has it."""
    return tuple(matrix.T.ravel().tolist())
