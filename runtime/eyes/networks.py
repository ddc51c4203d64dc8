"""Run the three face networks, which find faces, face meshes and irises in pictures.

Pixel coordinates are continuous: the centre of the first pixel is at (0.5, 0.5). *Left* means the viewer's left, which
is on the right in an unmirrored picture. The left eye comes first unless stated otherwise. For the origin of the
models, see `docs/sensors.md`.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from runtime.optics.stack import between_pixel_centres
from runtime.records import F32, F64, U8
from runtime.support.onnx_runtime import onnxruntime

MODELS = Path(str(files("runtime.eyes") / "models"))
STRIDES = (8, 16, 32)  # pixels per cell of YuNet's three grids
OVERLAP_MAX = 0.3  # two YuNet boxes count as the same face if their intersection over union is larger
CROP_BLUR = 0.45  # standard deviation of the anti-aliasing filter, in crop pixels


def load_network(name: str) -> Any:
    """Load a file of the `models` folder into a single-threaded session, and run it once, which is slow."""
    ort = onnxruntime()
    options = ort.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 3
    session = ort.InferenceSession(str(MODELS / name), options, providers=["CPUExecutionProvider"])
    (port,) = session.get_inputs()
    shape = (1, 3, 256, 320) if name == "yunet.onnx" else port.shape
    session.run(None, {port.name: np.zeros(shape, np.float32)})
    return session


def transformed(matrix: F64, points: F64) -> F64:
    """Apply a (2, 3) affine matrix to (n, 2) points."""
    result: F64 = points @ matrix[:, :2].T + matrix[:, 2]
    return result


def inverse(matrix: F64) -> F64:
    """Return the inverse of a (2, 3) affine matrix."""
    return np.asarray(cv2.invertAffineTransform(matrix), np.float64)


def resampled(picture: U8, size: tuple[int, int], crop_from_picture: F64) -> U8:
    """Crop and warp an RGB picture with anti-aliasing to (width, height), and repeat its edge outside.
    `crop_from_picture` (2, 3) maps continuous pixels.
    """
    ratio = 1 / np.sqrt(abs(np.linalg.det(crop_from_picture[:, :2])))  # picture pixels per crop pixel
    corners = np.array([[0, 0], [size[0], 0], [0, size[1]], [size[0], size[1]]], np.float64)
    seen = transformed(inverse(crop_from_picture), corners)
    height, width = picture.shape[:2]
    margin = 2 + 2 * ratio
    x0, y0 = np.clip(np.floor(seen.min(axis=0) - margin), 0, [width - 1, height - 1]).astype(int)
    x1, y1 = np.clip(np.ceil(seen.max(axis=0) + margin), [x0 + 1, y0 + 1], [width, height]).astype(int)
    part = picture[y0:y1, x0:x1]
    if ratio > 1.3:
        part = np.asarray(cv2.GaussianBlur(part, (0, 0), CROP_BLUR * np.sqrt(ratio * ratio - 1)), np.uint8)
    warp = crop_from_picture @ np.array([[1, 0, x0], [0, 1, y0], [0, 0, 1]])
    warp = between_pixel_centres(np.vstack([warp, [0, 0, 1]]))[:2]
    return np.asarray(cv2.warpAffine(part, warp, size, borderMode=cv2.BORDER_REPLICATE), np.uint8)


@dataclass(frozen=True, slots=True)
class Square:
    """A square region in a picture, rotated to align with a face."""

    centre: F64  # (2,) px
    side: float  # px
    angle: float  # direction of the lower edge, in radians clockwise on the screen

    def picture_from_crop(self, size: int, *, mirrored: bool = False) -> F64:
        """Return the (2, 3) matrix from a crop's continuous pixels, maybe mirrored, to the picture's."""
        c, s = np.cos(self.angle) * self.side / size, np.sin(self.angle) * self.side / size
        matrix = np.array([[-c if mirrored else c, -s], [-s if mirrored else s, c]])
        return np.column_stack([matrix, self.centre - matrix @ [size / 2, size / 2]])

    def crop(self, picture: U8, size: int, *, mirrored: bool = False) -> tuple[F32, F64]:
        """Return a (1, size, size, 3) crop with values from 0 to 1, and its matrix from `picture_from_crop`."""
        matrix = self.picture_from_crop(size, mirrored=mirrored)
        pixels = resampled(picture, (size, size), inverse(matrix))
        return np.divide(pixels[None], 255, dtype=np.float32), matrix


@dataclass(frozen=True, slots=True)
class FoundFace:
    """A face found by YuNet, with its bounding box and five points."""

    score: float  # 0 to 1
    box: F64  # (4,) x, y, width and height in pixels
    points: F64  # (5, 2) right eye, left eye, nose, right and left mouth corners, in pixels

    @property
    def size(self) -> float:
        """Side, in pixels, of a square with the same area as the box."""
        return float(np.sqrt(self.box[2] * self.box[3]))

    def square(self) -> Square:
        """Return the square region around the face to use as the mesh network's input."""
        eyes, mouth = self.points[:2].mean(axis=0), self.points[3:].mean(axis=0)
        line = self.points[1] - self.points[0]
        size = max(np.linalg.norm(line), 0.95 * np.linalg.norm(mouth - eyes))
        return Square(eyes + 0.45 * (mouth - eyes), float(4.4 * size), float(np.arctan2(line[1], line[0])))


class FaceNetwork:
    """YuNet, a network that finds faces anywhere in a picture."""

    def __init__(self) -> None:
        self._session = load_network("yunet.onnx")

    def find(self, picture: U8, *, longest_px: int, score_min: float) -> list[FoundFace]:
        """Return the faces in an RGB picture, from the highest score down to `score_min`. If its longer side
        exceeds `longest_px`, the picture is reduced to that before the search.
        """
        height, width = picture.shape[:2]
        scale = min(1.0, longest_px / max(height, width))
        small = picture
        if scale < 1:
            size = (max(1, round(width * scale)), max(1, round(height * scale)))
            small = np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.uint8)
        rows, columns = small.shape[:2]
        padded = np.zeros((1, 3, -(-rows // 32) * 32, -(-columns // 32) * 32), np.float32)
        padded[0, :, :rows, :columns] = small[:, :, ::-1].transpose(2, 0, 1)
        faces = self._decoded(self._session.run(None, {"input": padded}), padded.shape[3], score_min)
        ratio = np.array([width / columns, height / rows])
        return [FoundFace(face.score, face.box * np.tile(ratio, 2), (face.points + 0.5) * ratio) for face in faces]

    @staticmethod
    def _decoded(outputs: list[F32], width: int, score_min: float) -> list[FoundFace]:
        """Decode the grid cells that contain a face. If several faces overlap, only the best is kept."""
        faces = []
        for level, stride in enumerate(STRIDES):
            classes, objects, boxes, points = (outputs[kind * len(STRIDES) + level][0] for kind in range(4))
            scores = np.sqrt(np.clip(classes[:, 0], 0, 1) * np.clip(objects[:, 0], 0, 1))
            for cell in np.flatnonzero(scores > score_min):
                corner = np.array([cell % (width // stride), cell // (width // stride)])
                size = np.exp(boxes[cell, 2:].astype(np.float64)) * stride
                box = np.concatenate([(corner + boxes[cell, :2]) * stride - size / 2, size])
                five = (corner + points[cell].reshape(5, 2).astype(np.float64)) * stride
                faces.append(FoundFace(float(scores[cell]), box, five))
        boxes = [face.box.tolist() for face in faces]
        kept = cv2.dnn.NMSBoxes(boxes, [face.score for face in faces], score_min, OVERLAP_MAX)
        return [faces[index] for index in kept]


class MeshNetwork:
    """Network that finds 468 face points, numbered as in MediaPipe, in a square region of a picture."""

    SIZE = 192

    def __init__(self) -> None:
        self._session = load_network("face_mesh.onnx")

    def points(self, picture: U8, square: Square) -> tuple[F64, float]:
        """Return the (468, 3) face points, in pixels with z away from the camera, and a face's probability."""
        crop, matrix = square.crop(picture, self.SIZE)
        mesh, presence = self._session.run(None, {"input_1": crop})
        points = mesh.reshape(468, 3).astype(np.float64)
        certainty = 1 / (1 + np.exp(-float(presence.ravel()[0])))
        return np.column_stack([transformed(matrix, points[:, :2]), points[:, 2] * square.side / self.SIZE]), certainty


class IrisNetwork:
    """Network that finds the iris and the lids in a square region around an eye."""

    SIZE = 64

    def __init__(self) -> None:
        self._session = load_network("iris.onnx")

    def points(self, picture: U8, square: Square, *, is_left: bool) -> tuple[F64, F64]:
        """Return (5, 2) iris points, centre first, and (16, 2) points on the lower, then the upper lid, in
        pixels. The input of the viewer's left eye is mirrored.
        """
        crop, matrix = square.crop(picture, self.SIZE, mirrored=is_left)
        names = ["output_iris", "output_eyes_contours_and_brows"]
        iris, lids = self._session.run(names, {"input_1": crop})
        iris, lids = (one.reshape(-1, 3)[:, :2].astype(np.float64) for one in (iris, lids))
        return transformed(matrix, iris), transformed(matrix, lids[:16])
