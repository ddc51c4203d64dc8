"""Create and check picture networks: the published one, unrolled solver steps, or any `module:Class`."""

from __future__ import annotations

import logging
import os
import sys
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, redirect_stderr
from dataclasses import dataclass
from io import StringIO
from pathlib import Path
from typing import Annotated, Any, Literal

import torch
from pydantic import Field
from torch import Tensor, nn

from model_export.light import MOMENTUM, SIZE
from runtime.config import Section, validated
from runtime.errors import InputError, PhasestackError
from runtime.support.plugins import is_plugin, plugin_class, strict

KNOWN = {"eyereal": "model_export.eyereal:EyeRealNet", "unrolled": "model_export.unrolled:Unrolled"}
PANELS, COLOURS = 3, 3
STEPS_MOST = 64  # maximum number of steps that a contract can hold


class Form(Section):
    """A picture network's input and output format, which its class attributes override."""

    input_frame: Literal["centre", "panel"] = Field(
        "centre",
        description="pixels to which both eyes' pictures are resampled: those of the centre panel or of every panel",
    )
    input_value: Literal["intensity", "phase"] = "intensity"
    output: Literal["panels"] = "panels"
    branch: Literal[1, 2] = Field(1, description="branch of the phase sums: 1 for [0, 1] or 2 for [1, 2]")
    picture_fov_deg: Annotated[float, Field(ge=0, lt=180)] = Field(
        0.0,
        description="horizontal field of view of the input pictures, which are black outside it (0 for that of "
        "the content)",
    )

    steps: Annotated[int, Field(ge=0, le=STEPS_MOST)] = Field(
        0, description="number of solver steps after the network, in training and at run time"
    )

    @property
    def channels(self) -> int:
        """Number of input channels. They are ordered by panel, then eye, then RGB."""
        return (PANELS if self.input_frame == "panel" else 1) * 2 * COLOURS


@dataclass(frozen=True, slots=True)
class Network:
    """A picture network with its input and output format and its options."""

    arch: str  # name, or `module:Class`
    net: nn.Module
    form: Form
    options: dict[str, Any]  # arguments used to create `net`

    def steps(self) -> tuple[Sequence[Any], Sequence[Any]]:
        """Sizes and momenta of the steps that follow: tensors `step_sizes`, `step_momenta`, or constants."""
        learned = [getattr(self.net, name, None) for name in ("step_sizes", "step_momenta")]
        if isinstance(learned[0], Tensor) and isinstance(learned[1], Tensor):
            return list(learned[0].clamp(1e-3, 3)), list(learned[1].clamp(0, 0.99))
        return [SIZE] * self.form.steps, [MOMENTUM] * self.form.steps


@contextmanager
def blamed(arch: str, field: str) -> Iterator[None]:
    """Convert any exception of a user's module to an InputError that names the module and `field`."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    except PhasestackError:
        raise
    except (Exception, SystemExit) as error:
        text = str(error).strip().partition("\n")[0]
        raise InputError(arch, field, f"{type(error).__name__}: {text}" if text else type(error).__name__) from error


def check_known(arch: str, *others: str) -> None:
    """Raise InputError unless `arch` names a network or has the form `module:Class`."""
    if not is_plugin(arch) and arch not in (*others, *KNOWN):
        raise InputError("--arch", "", f"{arch!r} is not a network; use {', '.join([*others, *KNOWN])} or module:Class")


def make_network(arch: str, options: dict[str, Any], *, seed: int = 0) -> Network:
    """Create a picture network, by name or `module:Class`, with random weights. `options` are the class's
    arguments, and `steps`, the number of solver steps that follow. Raises InputError if the network is unknown, the
    class cannot be loaded or created, or an attribute or option is invalid.
    """
    check_known(arch)
    kind = plugin_class(KNOWN.get(arch, arch), nn.Module, field="--arch")
    attributes = {name: getattr(kind, name) for name in Form.model_fields if hasattr(kind, name)}
    schema = strict(getattr(kind, "Options", Section))
    attributes |= {name: options[name] for name in {"steps"} & set(options)}
    form = validated(Form, attributes, source=arch)
    options = {name: value for name, value in options.items() if name != "steps" or name in schema.model_fields}
    options = validated(schema, options, source=f"{arch}: --option").model_dump()
    torch.manual_seed(seed)
    with blamed(arch, "__init__"):
        net = kind(**options)
    return Network(arch, net, form, options)


def probe(network: Network, *, width_px: int, height_px: int) -> None:
    """Raise InputError unless the network maps pictures of this size to three finite panels."""
    arch, form = network.arch, network.form
    example = torch.rand(1, form.channels, height_px, width_px, generator=torch.Generator().manual_seed(1))
    expected = (1, PANELS * COLOURS, height_px, width_px)
    with torch.no_grad(), blamed(arch, f"forward, of {tuple(example.shape)}"):
        answer = network.net.eval()(example)
    if not isinstance(answer, Tensor):
        raise InputError(
            arch, "forward", f"returns an object of type {type(answer).__name__}, but must return a single tensor"
        )
    shape = tuple(answer.shape)
    for axis, size, needed in zip(("batch", "channels", "height", "width"), shape, expected, strict=False):
        if size != needed or len(shape) != len(expected):
            problem = f"returns a tensor of shape {shape} instead of {expected}; check the {axis}"
            raise InputError(arch, "forward", f"{problem} ({PANELS} panels of {COLOURS} colours)")
    if answer.dtype != torch.float32:
        raise InputError(arch, "forward", f"returns a tensor of type {answer.dtype} instead of torch.float32")
    if not torch.isfinite(answer).all():
        raise InputError(arch, "forward", "returns numbers that are not finite")


def check_static(network: Network, *, width_px: int, height_px: int) -> None:
    """Raise InputError if the network branches on its input's values, which a graph cannot represent."""
    example = torch.zeros(1, network.form.channels, height_px, width_px)
    try:
        with quiet(), redirect_stderr(StringIO()), torch.no_grad():  # torch prints any graph that it cannot trace
            torch.export.export(network.net.eval(), (example,), strict=False)
    except Exception as error:  # the exporter reports other failures
        if "data-dependent" in str(error).lower():
            problem = "branches on the values of its input, which a graph cannot represent; use torch.where"
            raise InputError(network.arch, "forward", problem) from None


@contextmanager
def quiet() -> Iterator[None]:
    """Suppress warnings meant for developers of torch's exporter, and graphs printed by its C++ code."""
    sys.stdout.flush()
    level, output = logging.root.manager.disable, os.dup(1)
    with Path(os.devnull).open("wb") as nothing:
        os.dup2(nothing.fileno(), 1)
    logging.disable(logging.WARNING)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logging.disable(level)
        os.dup2(output, 1)
        os.close(output)
