"""Shipped network, which solves along the line of the eyes in closed form, for a tracking error."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn import functional

from runtime.kernels import FULL

INPUTS = ("left", "right", "waves", "shifted_waves", "spectrum", "modes_in", "eye_sigma_px")
OUTPUTS = ("rear", "front", "check")
BLOCK_ROWS = 8  # rows that are transformed together; the raster consists of whole blocks
BOX = 0.5  # outer panels start in the middle of their range and can change by this much
IN_SCALE = 64  # codes per unit of the transformed inputs, which in codes would overflow half precision


class SpectralSolver(nn.Module):
    """Solver for both outer panels, given the eyes' residuals on epipolar rows.

    Let the panels be front = h + g and rear = h - g about the middle of their range. Let s be the parallax, in columns,
    that half the eyes' separation causes on either panel, e that of the centre panel, and w and v frequencies along the
    eyes' line and across it. The difference of the eyes' pictures is D = 4i·(sin(ws)cos(we)·g + cos(ws)sin(we)·h). A
    tracking error with standard deviations of c columns and r rows moves the panels' pictures in opposite directions.
    It attenuates the mean of a wave to m = exp(-(c²w² + r²v²)/2) and turns the rest into noise. The expected squared
    error has a closed-form minimum for every frequency (`gains`). The frequencies are those of the chain, combined with
    those of a block of `BLOCK_ROWS` rows and one cell's columns.
    """

    def __init__(self, cell_px: int = 4) -> None:
        super().__init__()
        self.cell_px = cell_px
        columns, w = _fourier(2 * cell_px)
        rows, v = _cosines(BLOCK_ROWS)
        self.columns: Tensor
        self.rows_in: Tensor
        self.rows_out: Tensor
        self.w: Tensor
        self.v: Tensor
        self.register_buffer("columns", columns, persistent=False)
        # Combine the block's row transform with a difference and sum: of the eyes on input, of g and h on output.
        into = torch.cat([torch.cat([-rows, rows], dim=1), torch.cat([rows, rows], dim=1)]) / IN_SCALE
        back = rows.transpose(0, 1) * FULL
        out = torch.stack([torch.cat([-back, back], dim=1), torch.cat([back, back], dim=1)])
        self.register_buffer("rows_in", into, persistent=False)
        self.register_buffer("rows_out", out, persistent=False)
        # Patterns: rows of the block, then columns of the cell.
        self.register_buffer("w", w.repeat(BLOCK_ROWS), persistent=False)
        self.register_buffer("v", v.repeat_interleave(2 * cell_px), persistent=False)
        self.log_floor = nn.Parameter(torch.log(torch.tensor([0.01, 0.2])))  # regularisation λ of g and of h
        self.log_rough = nn.Parameter(torch.log(torch.tensor([0.05, 0.2])))  # its growth with w²
        self.log_sigma_scale = nn.Parameter(torch.zeros(2))  # factors on eye_sigma_px along and across the eyes' line

    def gains(self, spectrum: Tensor, eye_sigma_px: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the numerator and denominator of g's gain without h's share, and the gain of h.

        Each is (patterns, cells + 1).
        """
        scale = torch.exp(self.log_sigma_scale)
        # A mode of the chain times a pattern of the block is two waves, at the pattern's frequency ± `offset`.
        offset = 2 * torch.asin(torch.clamp(spectrum / 4, 0, 1))[None] / (2 * self.cell_px)
        pattern = self.w[:, None]
        along2 = (eye_sigma_px[0] * scale[0]) ** 2 * (pattern * pattern + offset * offset)
        across = (eye_sigma_px[1] * scale[1] * self.v)[:, None]
        m2 = torch.exp(-(along2 + across * across))
        s2 = (spectrum * spectrum)[None]  # 16 sin²(ws)
        c2 = 16 - s2
        cos_2ws = 1 - s2 / 8
        cos_2we = torch.cos(2 * pattern * eye_sigma_px[2]) * torch.cos(2 * offset * eye_sigma_px[2])
        alpha2, beta2 = m2 * s2 * (1 + cos_2we) / 2, m2 * c2 * (1 - cos_2we) / 2
        floor = torch.exp(self.log_floor)[:, None, None] + torch.exp(self.log_rough)[:, None, None] * pattern * pattern
        noise, crossed = 8 * (1 - m2), 8 * cos_2ws * (m2 - m2 * m2)
        cost_g, cost_h = noise + crossed + floor[0], noise - crossed + floor[1]
        m = torch.sqrt(m2)
        share = cost_h / (cost_h + beta2)
        gain_h = m * torch.sqrt(c2) / (cost_h + beta2 + alpha2 * cost_h / cost_g)
        return share * m * spectrum[None], share * alpha2 + cost_g, gain_h

    def forward(self, *feeds: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the rear and the front panel, and a check that is finite if all intermediate numbers are.

        The panels are (rows, cells + 1, 2K·C) 16-bit codes, which begin one parallax before column 0.

        feeds: `INPUTS`, in this order. left, right: (rows, cells, 2K·C) 16-bit codes, each eye's residual along its
        rays through the raster. waves, shifted_waves, spectrum, modes_in: V and Ũ (cells + 1, cells + 1), s
        (cells + 1,) and U^T (cells + 1, cells) of `runtime.model.chain.chain_modes`. eye_sigma_px: (3,) c columns, r
        rows, e columns.
        """
        rear, front, check = self._solved(feeds, added=0.5)
        # The cast truncates. Adding a half makes it round, because values are clamped to be non-negative.
        codes = (_by_rows(torch.clamp(x, 0, FULL + 0.5), like=feeds[0]).to(torch.int16) for x in (rear, front))
        return (*codes, check)  # type: ignore[return-value]

    def _solved(self, feeds: tuple[Tensor, ...], *, added: float) -> tuple[Tensor, Tensor, Tensor]:
        """Return rear and front panel (1, block's rows, all else), in codes plus `added`, and the check.

        Each row of a cell stays contiguous throughout, and the same row of all blocks is stored together. This makes
        copies cheap, and the products with the rows' and the chain's matrices few and large.
        """
        left, right, waves, shifted_waves, spectrum, modes_in, eye_sigma_px = feeds
        channels = left.shape[2] // (2 * self.cell_px)
        numerator, denominator, gain_h = self.gains(spectrum, eye_sigma_px)
        numerator, gain_h = numerator * (IN_SCALE / FULL), gain_h * (IN_SCALE / FULL)
        sides = torch.cat([_by_block_rows(left), _by_block_rows(right)]).to(torch.float32)
        bias = torch.full((BLOCK_ROWS,), BOX * FULL + added, device=left.device)
        rows, cells = 2 * BLOCK_ROWS, sides.shape[1]
        both = torch.matmul(self.rows_in, sides.reshape(rows, -1)).reshape(rows, cells, -1)
        both = torch.matmul(modes_in, both).reshape(rows, -1, *sides.shape[2:])
        both = self._in_columns(both, torch.cat([numerator / denominator, gain_h]), channels)
        both = both.reshape(2, BLOCK_ROWS, both.shape[1], -1)
        both = torch.matmul(torch.stack([waves, shifted_waves])[:, None], both).reshape(1, rows, -1)
        # Written as a convolution, the matrix product is fused with the addition and the clamp.
        rear, front = (functional.conv1d(both, out[..., None], bias) for out in self.rows_out)
        return rear, front, _size(both)

    def _in_columns(self, x: Tensor, gains: Tensor, channels: int) -> Tensor:
        """Scale the waves along the columns of x by their gains.

        x: (n waves of the rows, modes, blocks, 2K·C); gains: (n·2K, modes). One matrix for each mode and wave of the
        rows transforms to the columns' waves, scales them, and transforms back.
        """
        count, modes, _, row = x.shape
        # Projections of a cell's row on each of the columns' waves.
        parts = self.columns[:, :, None, None, None] * self.columns[:, None, None, :, None]
        parts = (parts * _same(channels, like=parts)).reshape(2 * self.cell_px, -1)
        matrices = torch.matmul(gains.reshape(count, -1, modes).transpose(1, 2), parts)
        return torch.matmul(x, matrices.reshape(count, modes, row, row))


def _same(channels: int, *, like: Tensor) -> Tensor:
    """Return the identity over channels (C, 1, C)."""
    one = torch.arange(channels, device=like.device)
    return (one[:, None, None] == one).to(torch.float32)


def _by_block_rows(image: Tensor) -> Tensor:
    """Rearrange an image (rows, cells, 2K·C) to (block's rows, cells, blocks, 2K·C)."""
    return image.reshape(-1, BLOCK_ROWS, *image.shape[1:]).permute(1, 2, 0, 3)


def _by_rows(x: Tensor, *, like: Tensor) -> Tensor:
    """Invert `_by_block_rows` for x (block's rows, all else), with one cell more than the input `like`."""
    cells, row = like.shape[1] + 1, like.shape[2]
    return x.reshape(BLOCK_ROWS, cells, -1, row).permute(2, 0, 1, 3).reshape(-1, cells, row)


def _size(x: Tensor) -> Tensor:
    """Return the norm (1,) of x. It is finite only if x is, with a margin for later products."""
    size: Tensor = torch.linalg.vector_norm(x)  # squares overflow long before later results would
    return size.reshape(1)


def _fourier(size: int) -> tuple[Tensor, Tensor]:
    """Return the orthonormal real Fourier basis (size, size) and its frequencies in radians per sample.

    Each row of the basis is one wave.
    """
    at = torch.arange(size, dtype=torch.float64)
    rows, w = [torch.ones(size, dtype=torch.float64) / math.sqrt(size)], [0.0]
    for k in range(1, (size + 1) // 2):
        for wave in (torch.cos, torch.sin):
            rows.append(wave(2 * math.pi * k * at / size) * math.sqrt(2 / size))
            w.append(2 * math.pi * k / size)
    if size % 2 == 0:
        rows.append(torch.cos(math.pi * at) / math.sqrt(size))
        w.append(math.pi)
    return torch.stack(rows).float(), torch.tensor(w)


def _cosines(size: int) -> tuple[Tensor, Tensor]:
    """Return the orthonormal cosine basis (size, size) and its frequencies in radians per sample.

    Each row of the basis is one wave.
    """
    k, at = torch.arange(size, dtype=torch.float64)[:, None], torch.arange(size, dtype=torch.float64) + 0.5
    basis = torch.cos(math.pi * k * at / size) * math.sqrt(2 / size)
    basis[0] /= math.sqrt(2)
    return basis.float(), math.pi * k[:, 0].float() / size
