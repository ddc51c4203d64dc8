"""The shipped network: the whole solving along the eyes' line, for eyes that are known so well and no better."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

INPUTS = ("left", "right", "waves", "shifted_waves", "spectrum", "modes_in", "doubt")
OUTPUTS = ("rear", "front", "check")
BLOCK_ROWS = 8  # rows that are transformed together; the raster has whole blocks
FULL = 255 * 16  # one panel's range in the units of inputs and outputs: sixteenths of an 8-bit code
BOX = 0.5  # every outer panel starts in the middle of its range, and can go so far from there


class SpectralSolver(nn.Module):
    """What both outer panels must carry, from what each eye lacks, chain by chain.

    With front = h + g and rear = h - g about the middle of their range, s columns the parallax of half the eyes'
    separation on either panel, e the centre panel's own, and a frequency w along the eyes' line, the eyes' difference
    is D = 4i·(sin(ws)cos(we)·g + cos(ws)sin(we)·h). Eyes that err by c columns and r rows (standard deviations) move
    both panels' pictures in opposite directions: m = exp(-(c²w² + r²v²)/2) is what is left of a wave in the mean, and
    what is not left is noise. The least squares of the expected error are closed-form for every frequency (`gains`);
    the panels' range is kept by unrolled steps of ADMM with over-relaxation. Frequencies are those of the chain times
    those of a block of `BLOCK_ROWS` rows and one cell's columns.
    """

    def __init__(self, cell_px: int = 4, iterations: int = 4) -> None:
        super().__init__()
        self.cell_px, self.iterations = cell_px, iterations
        columns, w = _fourier(2 * cell_px)
        rows, v = _cosines(BLOCK_ROWS)
        # Row by row of the block, then column by column of the cell.
        self.patterns: Tensor
        self.w: Tensor
        self.v: Tensor
        self.register_buffer("patterns", torch.kron(rows, columns), persistent=False)
        self.register_buffer("w", w.repeat(BLOCK_ROWS), persistent=False)
        self.register_buffer("v", v.repeat_interleave(2 * cell_px), persistent=False)
        self.log_floor = nn.Parameter(torch.log(torch.tensor([0.01, 0.2])))  # λ of g and of h
        self.log_rough = nn.Parameter(torch.log(torch.tensor([0.05, 0.2])))  # and how they grow with w²
        self.log_doubt = nn.Parameter(torch.zeros(2))  # how much the doubt along the line and across it weighs
        self.log_penalty = nn.Parameter(torch.full((iterations,), math.log(0.05)))
        self.relaxation = nn.Parameter(torch.full((iterations,), 1.6))

    def gains(self, spectrum: Tensor, doubt: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """(patterns, cells + 1) each: numerator and denominator of g, with what h takes over left out, and h's gain."""
        scale = torch.exp(self.log_doubt)
        # A mode of the chain in a pattern of the block is two waves, its frequency beside the pattern's either way.
        beside = 2 * torch.asin(torch.clamp(spectrum / 4, 0, 1))[None] / (2 * self.cell_px)
        pattern = self.w[:, None]
        along2 = (doubt[0] * scale[0]) ** 2 * (pattern * pattern + beside * beside)
        across = (doubt[1] * scale[1] * self.v)[:, None]
        m2 = torch.exp(-(along2 + across * across))
        s2 = (spectrum * spectrum)[None]  # 16 sin²(ws)
        c2 = 16 - s2
        cos_2ws = 1 - s2 / 8
        cos_2we = torch.cos(2 * pattern * doubt[2]) * torch.cos(2 * beside * doubt[2])
        alpha2, beta2 = m2 * s2 * (1 + cos_2we) / 2, m2 * c2 * (1 - cos_2we) / 2
        floor = torch.exp(self.log_floor)[:, None, None] + torch.exp(self.log_rough)[:, None, None] * pattern * pattern
        noise, crossed = 8 * (1 - m2), 8 * cos_2ws * (m2 - m2 * m2)
        cost_g, cost_h = noise + crossed + floor[0], noise - crossed + floor[1]
        m = torch.sqrt(m2)
        share = cost_h / (cost_h + beta2)
        gain_h = m * torch.sqrt(c2) / (cost_h + beta2 + alpha2 * cost_h / cost_g)
        return share * m * spectrum[None], share * alpha2 + cost_g, gain_h

    def forward(
        self,
        left: Tensor,
        right: Tensor,
        waves: Tensor,
        shifted_waves: Tensor,
        spectrum: Tensor,
        modes_in: Tensor,
        doubt: Tensor,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """`panels` in 16-bit codes, and one number that is finite where all that was worked out is."""
        rear, front = self.panels(left, right, waves, shifted_waves, spectrum, modes_in, doubt)
        check = (rear.mean() + front.mean()).reshape(1)
        codes = (torch.clamp(torch.round(x * FULL), 0, FULL).to(torch.int16) for x in (rear, front))
        return (*codes, check)  # type: ignore[return-value]

    def panels(
        self,
        left: Tensor,
        right: Tensor,
        waves: Tensor,
        shifted_waves: Tensor,
        spectrum: Tensor,
        modes_in: Tensor,
        doubt: Tensor,
    ) -> tuple[Tensor, Tensor]:
        """Rear and front panel (rows, cells + 1, 2K·C), from one parallax before the first column; not clamped.

        left, right (rows, cells, 2K·C), 16-bit codes: what each eye lacks along its rays through the raster; waves
        (cells + 1, cells + 1) V, shifted_waves Ũ, spectrum (cells + 1,) s and modes_in (cells + 1, cells) U^T
        (`runtime.model.chain.chain_modes`); doubt (3,): c columns, r rows, e columns.
        """
        channels = left.shape[2] // (2 * self.cell_px)
        sides = [self._packed(side.to(torch.float32) * (1.0 / FULL), channels) for side in (left, right)]
        numerator, denominator, gain_h = self.gains(spectrum, doubt)
        # The eyes' difference, and its counterpart by the centre's parallax, as waves of chain and block.
        difference = torch.matmul(modes_in, self._to_patterns(sides[1] - sides[0]))
        counterpart = torch.matmul(modes_in, self._to_patterns(sides[1] + sides[0]))
        wanted = numerator[..., None] * difference
        h = self._to_pixels(torch.matmul(shifted_waves, gain_h[..., None] * counterpart))
        if self.iterations == 0:
            g = self._to_pixels(torch.matmul(waves, wanted / denominator[..., None]))
        else:
            g = self._boxed(wanted, denominator, waves)
        return self._unpacked(BOX + h - g, channels), self._unpacked(BOX + h + g, channels)

    def _boxed(self, wanted: Tensor, denominator: Tensor, waves: Tensor) -> Tensor:
        """Alternating directions: the quadratic in the modes, the panels' range in the pixels."""
        back = waves.transpose(0, 1)
        # It starts from nothing: the first turn is the regularised solution.
        z = u = torch.zeros(())
        for k in range(self.iterations):
            penalty, relaxation = torch.exp(self.log_penalty[k]), self.relaxation[k]
            target = wanted
            if k:
                target = wanted + penalty * torch.matmul(back, self._to_patterns(z - u))
            x = self._to_pixels(torch.matmul(waves, target / (denominator + penalty)[..., None]))
            moved = relaxation * x + ((1 - relaxation) * z + u if k else 0.0)
            z = torch.clamp(moved, -BOX, BOX)
            u = moved - z
        return z + 0.0 * u  # no number that is not finite is lost in the clamp

    def _packed(self, image: Tensor, channels: int) -> Tensor:
        """(rows, cells, 2K·C) to (block's pixels, cells, blocks·C)."""
        cells, columns = image.shape[1], 2 * self.cell_px
        x = image.reshape(-1, BLOCK_ROWS, cells, columns, channels).permute(1, 3, 2, 0, 4)
        return x.reshape(BLOCK_ROWS * columns, cells, -1)

    def _unpacked(self, x: Tensor, channels: int) -> Tensor:
        """The other way round."""
        cells, columns = x.shape[1], 2 * self.cell_px
        image = x.reshape(BLOCK_ROWS, columns, cells, -1, channels).permute(3, 0, 2, 1, 4)
        return image.reshape(-1, cells, columns * channels)

    def _to_patterns(self, x: Tensor) -> Tensor:
        return torch.matmul(self.patterns, x.reshape(x.shape[0], -1)).reshape(x.shape)

    def _to_pixels(self, x: Tensor) -> Tensor:
        return torch.matmul(self.patterns.transpose(0, 1), x.reshape(x.shape[0], -1)).reshape(x.shape)


def _fourier(size: int) -> tuple[Tensor, Tensor]:
    """Orthonormal real Fourier basis (size, size), a row a wave, and each wave's frequency in radians a sample."""
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
    """Orthonormal cosine basis (size, size), a row a wave, and each wave's frequency in radians a sample."""
    k, at = torch.arange(size, dtype=torch.float64)[:, None], torch.arange(size, dtype=torch.float64) + 0.5
    basis = torch.cos(math.pi * k * at / size) * math.sqrt(2 / size)
    basis[0] /= math.sqrt(2)
    return basis.float(), math.pi * k[:, 0].float() / size
