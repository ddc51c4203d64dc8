"""Run the three face networks on square crops of a picture.

Pixels are continuous: the centre of the first one is (0.5, 0.5). *Left* is the viewer's left, which is on the right of
an unmirrored picture. It comes first unless stated otherwise. `docs/sensors.md` gives the origin of the models.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from runtime.records import F32, F64, U8
from runtime.support.onnx_runtime import onnxruntime

MODELS = Path(str(files("runtime.eyes") / "models"))
STRIDES = (8, 16, 32)  # pixels per cell of YuNet's three grids
OVERLAP_MAX = 0.3  # intersection over union above which two of YuNet's boxes are the same face
CROP_BLUR = 0.45  # standard deviation of the anti-aliasing filter, in the crop's pixels


def load_network(name: str) -> Any:
    """Load a network as a single-threaded onnxruntime session and run it once, as first runs are slow.

    name: of a file in the folder `models`.
    """
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
    """Apply an affine matrix (2, 3) to points (n, 2)."""
    result: F64 = points @ matrix[:, :2].T + matrix[:, 2]
    return result


def inverse(matrix: F64) -> F64:
    """Return the inverse of an affine matrix (2, 3)."""
    return np.asarray(cv2.invertAffineTransform(matrix), np.float64)


def resampled(picture: U8, size: tuple[int, int], crop_from_picture: F64) -> U8:
    """Warp a picture by an affine matrix (2, 3) of continuous pixels, with anti-aliasing.

    Outside the picture, the pixels of its edge are repeated. size: (width, height) of the result.
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
    warp = crop_from_picture.copy()
    warp[:, 2] += warp[:, :2] @ [x0 + 0.5, y0 + 0.5] - 0.5  # continuous pixels to array indices
    return np.asarray(cv2.warpAffine(part, warp, size, borderMode=cv2.BORDER_REPLICATE), np.uint8)


@dataclass(frozen=True, slots=True)
class Square:
    """Square region of a picture, rotated to align with the face in it."""

    centre: F64  # (2,) px
    side: float  # px
    angle: float  # direction of its lower edge, radians clockwise on the screen

    def picture_from_crop(self, size: int, *, mirrored: bool = False) -> F64:
        """Return the matrix (2, 3) from continuous pixels of a crop, `size` pixels wide, to the picture's."""
        c, s = np.cos(self.angle) * self.side / size, np.sin(self.angle) * self.side / size
        matrix = np.array([[-c if mirrored else c, -s], [-s if mirrored else s, c]])
        return np.column_stack([matrix, self.centre - matrix @ [size / 2, size / 2]])

    def crop(self, picture: U8, size: int, *, mirrored: bool = False) -> tuple[F32, F64]:
        """Return a crop (1, size, size, 3) with values in [0, 1], and its matrix `picture_from_crop`."""
        matrix = self.picture_from_crop(size, mirrored=mirrored)
        pixels = resampled(picture, (size, size), inverse(matrix))
        return np.divide(pixels[None], 255, dtype=np.float32), matrix


@dataclass(frozen=True, slots=True)
class FoundFace:
    """Face found by YuNet."""

    score: float  # 0 to 1
    box: F64  # (4,) x, y, width, height, px
    points: F64  # (5, 2) px: right eye, left eye, nose, right and left corner of the mouth

    @property
    def size(self) -> float:
        """Side length in pixels of a square with the same area as the box."""
        return float(np.sqrt(self.box[2] * self.box[3]))

    def square(self) -> Square:
        """Square region around the face, used as input for the mesh network."""
        eyes, mouth = self.points[:2].mean(axis=0), self.points[3:].mean(axis=0)
        line = self.points[1] - self.points[0]
        size = max(np.linalg.norm(line), 0.95 * np.linalg.norm(mouth - eyes))
        return Square(eyes + 0.45 * (mouth - eyes), float(4.4 * size), float(np.arctan2(line[1], line[0])))


class FaceNetwork:
    """YuNet, which finds faces anywhere in a picture."""

    def __init__(self) -> None:
        self._session = load_network("yunet.onnx")

    def find(self, picture: U8, *, longest_px: int, score_min: float) -> list[FoundFace]:
        """Return the faces in an RGB picture (h, w, 3), best first.

        longest_px: longer side to which a larger picture is reduced; score_min: minimum score of a face.
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
        """Decode the grid cells that contain a face. Of overlapping faces, keep the one with the best score."""
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
    """Network that finds 468 face points, numbered as in MediaPipe, in a square region of the picture."""

    SIZE = 192

    def __init__(self) -> None:
        self._session = load_network("face_mesh.onnx")

    def points(self, picture: U8, square: Square) -> tuple[F64, float]:
        """Return points (468, 3) in pixels, z away from the camera, and the probability that this is a face."""
        crop, matrix = square.crop(picture, self.SIZE)
        mesh, presence = self._session.run(None, {"input_1": crop})
        points = mesh.reshape(468, 3).astype(np.float64)
        certainty = 1 / (1 + np.exp(-float(presence.ravel()[0])))
        return np.column_stack([transformed(matrix, points[:, :2]), points[:, 2] * square.side / self.SIZE]), certainty


class IrisNetwork:
    """Network that finds the iris in a square around an eye. Its input is mirrored for right eyes."""

    SIZE = 64

    def __init__(self) -> None:
        self._session = load_network("iris.onnx")

    def points(self, picture: U8, square: Square, *, is_left: bool) -> tuple[F64, F64]:
        """Return centre and edge points of the iris (5, 2) and lid points (16, 2), lower lid first."""
        crop, matrix = square.crop(picture, self.SIZE, mirrored=is_left)
        names = ["output_iris", "output_eyes_contours_and_brows"]
        iris, lids = self._session.run(names, {"input_1": crop})
        iris, lids = (one.reshape(-1, 3)[:, :2].astype(np.float64) for one in (iris, lids))
        return transformed(matrix, iris), transformed(matrix, lids[:16])
