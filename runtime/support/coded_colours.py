"""Colours of pictures and films: those declared by code (ITU-T H.273), and transparent ones over
a background.
"""

from __future__ import annotations

import re
import struct

import cv2
import numpy as np

from runtime.records import F64, U8

NCLX = re.compile(rb"colrnclx(..)(..)", re.DOTALL)
SEARCHED = 1 << 18  # number of bytes at the beginning of a file to search for the colour codes
PQ, HLG = 16, 18  # transfer characteristics codes; all other codes are treated as sRGB
BRIGHT = (PQ, HLG)
Colour = tuple[float, float, float]  # sRGB components in [0, 1]
PAPER_NITS, PQ_NITS = 203.0, 10_000.0  # white's luminance (ITU-R BT.2408), and PQ's maximum luminance
PRIMARIES = {  # XYZ of red, green and blue, keyed by code and adapted to D50; code 1 (BT.709) has sRGB's primaries
    1: ((0.43607, 0.22249, 0.01392), (0.38515, 0.71687, 0.09708), (0.14307, 0.06061, 0.71410)),
    9: ((0.67348, 0.27905, -0.00193), (0.16566, 0.67534, 0.02998), (0.12505, 0.04561, 0.79686)),
    12: ((0.51512, 0.24120, -0.00105), (0.29198, 0.69225, 0.04189), (0.15710, 0.06657, 0.78407)),
}
D50 = (0.9642, 1.0, 0.8249)
SRGB_CURVE = (2.4, 1 / 1.055, 0.055 / 1.055, 1 / 12.92, 0.04045)  # an ICC curve's parameters g, a, b, c, d
SAMPLES = 4096  # number of samples in a transfer curve
ROWS = 32  # rows converted together, which fit into a processor's cache


def composed(colour: U8, alpha: U8, background: Colour) -> U8:
    """Compose pictures (h, w, 3), rounded: colour·a + background·(1 - a), with `alpha` (h, w, 1) = 255·a."""
    behind = np.array([round(255 * value) for value in background], np.uint16) * (255 - alpha.astype(np.uint16))
    return np.asarray((colour.astype(np.uint16) * alpha + behind + 127) // 255, np.uint8)  # terms below 65,153


def stated_profile(coded: bytes) -> bytes:
    """Return the ICC profile of an encoded picture's (or its beginning's) declared colours, or b""."""
    found = NCLX.search(coded[:SEARCHED]) if coded[4:8] == b"ftyp" else None
    if found is None:
        return b""
    primaries, transfer = (int.from_bytes(code, "big") for code in found.groups())
    is_bright = transfer in BRIGHT
    if primaries not in PRIMARIES or (primaries == 1 and not is_bright):
        return b""
    curve = _table(transfer) if is_bright else b"para" + bytes(4) + struct.pack(">HH", 3, 0) + _fixed(*SRGB_CURVE)
    places = (*PRIMARIES[primaries], D50)
    tags = [(name, b"XYZ " + bytes(4) + _fixed(*xyz)) for name, xyz in zip(("rXYZ", "gXYZ", "bXYZ", "wtpt"), places)]
    tags += [(name, curve) for name in ("rTRC", "gTRC", "bTRC")]
    index, body, start = b"", b"", 128 + 4 + 12 * len(tags)
    for name, content in tags:
        index += struct.pack(">4sLL", name.encode(), start + len(body), len(content))
        body += content + bytes(-len(content) % 4)
    head = struct.pack(">LLL4s4s4s", start + len(body), 0, 0x04300000, b"mntr", b"RGB ", b"XYZ ") + bytes(12) + b"acsp"
    return (head + bytes(28) + _fixed(*D50)).ljust(128, b"\0") + struct.pack(">L", len(tags)) + index + body


def _fixed(*values: float) -> bytes:
    return b"".join(struct.pack(">l", round(value * 65536)) for value in values)


def _table(transfer: int) -> bytes:
    """Return an ICC curve that maps codes to light relative to paper white. Brighter light is clipped."""
    code = np.linspace(0.0, 1.0, SAMPLES)
    light = _pq(code) if transfer == PQ else _hlg(code) / _hlg(np.array(0.75))  # the HLG code of paper white is 0.75
    values = np.rint(np.clip(light, 0.0, 1.0) * 65535).astype(">u2")
    return b"curv" + bytes(4) + struct.pack(">L", SAMPLES) + values.tobytes()


def _pq(code: F64) -> F64:
    """Decode the perceptual quantizer (PQ, SMPTE ST 2084) to light relative to paper white."""
    root = code ** (1 / 78.84375)
    shown = np.maximum(root - 0.8359375, 0.0) / (18.8515625 - 18.6875 * root)
    return np.asarray(shown ** (1 / 0.1593017578125) * (PQ_NITS / PAPER_NITS))


def _hlg(code: F64) -> F64:
    """Decode hybrid log-gamma (HLG, ARIB STD-B67) per channel, with the gamma of a 1000-nit screen."""
    a, b, c = 0.17883277, 0.28466892, 0.55991073
    return np.asarray(np.where(code <= 0.5, code**2 / 3, (np.exp((code - c) / a) + b) / 12) ** 1.2)


def srgb_from(rgb: U8, *, primaries: int, transfer: int) -> U8:
    """Convert an (h, w, 3) picture from PQ or HLG to sRGB, clipped at paper white."""
    code = np.linspace(0.0, 1.0, 256)
    light = _pq(code) if transfer == PQ else _hlg(code) / _hlg(np.array(0.75))
    own, srgb = (np.array(PRIMARIES.get(number, PRIMARIES[1])).T for number in (primaries, 1))
    matrix, steps = np.linalg.inv(srgb) @ own * (SAMPLES - 1), np.linspace(0.0, 1.0, SAMPLES)
    curve = np.where(steps <= 0.0031308, 12.92 * steps, 1.055 * steps ** (1 / 2.4) - 0.055)
    table, converted = np.rint(255 * curve).astype(np.uint8), np.empty_like(rgb)
    for first in range(0, len(rgb), ROWS):
        linear = cv2.transform(cv2.LUT(rgb[first : first + ROWS], np.clip(light, 0, 1).astype(np.float32)), matrix)
        np.take(table, np.rint(linear).astype(np.int16), mode="clip", out=converted[first : first + ROWS])
    return converted
