"""The shipped models' network, which solves for the outer panels in closed form."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn import functional

from runtime.kernels import FULL

OUTPUTS = ("rear", "front", "check")
BLOCK_ROWS = 8  # number of rows transformed together; the raster consists of complete blocks
BOX = 0.5  # maximum change in the outer panels, which start at the middle of their range
IN_SCALE = 64  # divisor of the transformed inputs, which would otherwise overflow half precision


class SpectralSolver(nn.Module):
    """Solver that computes both outer panels from the eyes' residuals on epipolar rows.

    Let the panels be front = h + g and rear = h - g about the middle of their range. Let s be the parallax, in columns,
    caused on an outer panel by half the eyes' separation, and e the same parallax on the centre panel. Let w be a
    frequency along the line through the eyes and v a frequency across it. The difference between the eyes' pictures is
    D = 4i·(sin(ws)cos(we)·g + cos(ws)sin(we)·h).

    A tracking error with standard deviations of c columns and r rows shifts the two panels' pictures in opposite
    directions. It attenuates a wave's mean by the factor m = exp(-(c²w² + r²v²)/2) and turns the rest into noise. The
    expected squared error has a closed-form minimum for every frequency (`gains`).

    A raster row consists of cells, each 2K columns wide. The transform along a row combines the chain's modes
    (`runtime.model.chain`) with the frequencies of a cell's columns. The transform across the rows covers a block of
    `BLOCK_ROWS` rows. K may differ from run to run, because a cell's waves are inputs. The unit of length along a row
    is always the parallax divided by `cell_px`, so that the gains do not depend on K.
    """

    def __init__(self, cell_px: int = 4) -> None:
        super().__init__()
        self.cell_px = cell_px
        rows, v = _cosines(BLOCK_ROWS)
        self.rows_in: Tensor
        self.rows_out: Tensor
        self.v: Tensor
        # A block's row transform also computes a difference and a sum: of the eyes on input, of g and h on output.
        into = torch.cat([torch.cat([-rows, rows], dim=1), torch.cat([rows, rows], dim=1)]) / IN_SCALE
        back = rows.transpose(0, 1) * FULL
        out = torch.stack([torch.cat([-back, back], dim=1), torch.cat([back, back], dim=1)])
        self.register_buffer("rows_in", into, persistent=False)
        self.register_buffer("rows_out", out, persistent=False)
        self.register_buffer("v", v[:, None], persistent=False)
        self.log_floor = nn.Parameter(torch.log(torch.tensor([0.01, 0.2])))  # regularisation λ of g and of h
        self.log_rough = nn.Parameter(torch.log(torch.tensor([0.05, 0.2])))  # increase of λ with w²
        self.log_sigma_scale = nn.Parameter(torch.zeros(2))  # factors for eye_sigma_px along and across the eyes' line

    def gains(self, spectrum: Tensor, cell_frequencies: Tensor, eye_sigma_px: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the numerator and denominator of g's gain without the part explained by h, and h's gain. All
        have shape (patterns, cells + 1): a pattern is a wave along a block's rows times one along a cell's columns.
        `spectrum` are the chain's singular values; the others are inputs of `forward`.
        """
        scale = torch.exp(self.log_sigma_scale)
        # The product of a chain mode and a block's pattern is two waves, at the pattern's frequency ± `offset`.
        offset = 2 * torch.asin(torch.clamp(spectrum / 4, 0, 1))[None] / (2 * self.cell_px)
        pattern = (cell_frequencies[None] / self.cell_px + torch.zeros_like(self.v)).reshape(-1, 1)
        pattern_v = (self.v + torch.zeros_like(cell_frequencies)[None]).reshape(-1, 1)
        along2 = (eye_sigma_px[0] * scale[0]) ** 2 * (pattern * pattern + offset * offset)
        across = eye_sigma_px[1] * scale[1] * pattern_v
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
        """Compute the rear and front panels for C colour channels from the tensors named in `INPUTS`.

        * `left`, `right`: each eye's residual along its rays through the raster, (rows, cells, 2K·C) 16-bit codes.
        * `waves`, `shifted_waves`, `spectrum`, `modes_in`: V and Ũ (cells + 1, cells + 1), s (cells + 1,) and
         U^T (cells + 1, cells) from `runtime.model.chain.chain_modes`.
        * `cell_waves`, `cell_frequencies`: (2K, 2K) and (2K,) from `runtime.model.chain.cell_waves`.
        * `eye_sigma_px`: c, r and e (3,). c and e are in units of the parallax divided by `cell_px`, and r is in rows.

        Panels are (rows, cells + 1, 2K·C) 16-bit codes that begin one parallax before column 0. The last output (1,) is
        finite if all intermediate results are.
        """
        rear, front, check = self._solved(feeds, added=0.5)
        # The cast truncates. Having a half added makes it round instead, because the values are clamped to be
        # non-negative.
        codes = (_by_rows(torch.clamp(x, 0, FULL + 0.5), like=feeds[0]).to(torch.int16) for x in (rear, front))
        return (*codes, check)  # type: ignore[return-value]

    def _solved(self, feeds: tuple[Tensor, ...], *, added: float) -> tuple[Tensor, Tensor, Tensor]:
        """Return the rear and front panels, each (1, rows of a block, all others), in 16-bit codes plus `added`, and
        the check. Corresponding rows of all blocks are stored together, and each row of a cell stays contiguous. Copies
        are therefore cheap, and the products with the row and chain matrices are few and large.
        """
        left, right, waves, shifted_waves, spectrum, modes_in, cell_waves, cell_frequencies, eye_sigma_px = feeds
        numerator, denominator, gain_h = self.gains(spectrum, cell_frequencies, eye_sigma_px)
        numerator, gain_h = numerator * (IN_SCALE / FULL), gain_h * (IN_SCALE / FULL)
        sides = torch.cat([_by_block_rows(left), _by_block_rows(right)]).to(torch.float32)
        bias = torch.full((BLOCK_ROWS,), BOX * FULL + added, device=left.device)
        rows, cells = 2 * BLOCK_ROWS, sides.shape[1]
        both = torch.matmul(self.rows_in, sides.reshape(rows, -1)).reshape(rows, cells, -1)
        both = torch.matmul(modes_in, both).reshape(rows, -1, *sides.shape[2:])
        both = _in_columns(both, torch.cat([numerator / denominator, gain_h]), cell_waves)
        both = both.reshape(2, BLOCK_ROWS, both.shape[1], -1)
        both = torch.matmul(torch.stack([waves, shifted_waves])[:, None], both).reshape(1, rows, -1)
        # The matrix product is written as a convolution so that it is fused with the addition and the clamp.
        rear, front = (functional.conv1d(both, out[..., None], bias) for out in self.rows_out)
        return rear, front, _size(both)


def _in_columns(x: Tensor, gains: Tensor, cell_waves: Tensor) -> Tensor:
    """Scale each wave along a cell's columns (2K, 2K) by its gain (n·2K, modes), for values (n, modes, blocks, 2K·C).
    For each row wave and each mode, a single matrix transforms the columns to waves, scales the waves and transforms
    them back.
    """
    count, modes, _, row = x.shape
    columns = cell_waves.shape[0]
    # Projections of a cell's row onto each column wave.
    parts = cell_waves[:, :, None, None, None] * cell_waves[:, None, None, :, None]
    parts = (parts * _same(row // columns, like=parts)).reshape(columns, -1)
    matrices = torch.matmul(gains.reshape(count, -1, modes).transpose(1, 2), parts)
    return torch.matmul(x, matrices.reshape(count, modes, row, row))


def _same(channels: int, *, like: Tensor) -> Tensor:
    """Return the identity matrix over the colour channels as a (C, 1, C) tensor."""
    one = torch.arange(channels, device=like.device)
    return (one[:, None, None] == one).to(torch.float32)


def _by_block_rows(image: Tensor) -> Tensor:
    """Rearrange an image from (rows, cells, 2K·C) to (rows of a block, cells, blocks, 2K·C)."""
    return image.reshape(-1, BLOCK_ROWS, *image.shape[1:]).permute(1, 2, 0, 3)


def _by_rows(x: Tensor, *, like: Tensor) -> Tensor:
    """Invert `_by_block_rows` for a tensor (rows of a block, all others) with one more cell than `like`."""
    cells, row = like.shape[1] + 1, like.shape[2]
    return x.reshape(BLOCK_ROWS, cells, -1, row).permute(2, 0, 1, 3).reshape(-1, cells, row)


def _size(x: Tensor) -> Tensor:
    """Return a tensor's norm (1,), which is finite only if all values are finite and not too large."""
    size: Tensor = torch.linalg.vector_norm(x)  # the squares overflow long before later products would
    return size.reshape(1)


def _cosines(size: int) -> tuple[Tensor, Tensor]:
    """Return the orthonormal cosine basis (size, size), a wave per row, and its frequencies in radians per sample."""
    k, at = torch.arange(size, dtype=torch.float64)[:, None], torch.arange(size, dtype=torch.float64) + 0.5
    basis = torch.cos(math.pi * k * at / size) * math.sqrt(2 / size)
    basis[0] /= math.sqrt(2)
    return basis.float(), math.pi * k[:, 0].float() / size
