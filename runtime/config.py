"""One TOML file -> validated, frozen settings. Every default and its meaning is here.

Values are held to what a display can be built and run with, so that a wrong unit is told and not shown. Paths in a
file are relative to the folder of the file.
"""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    ValidationError,
    field_validator,
    model_validator,
)

from runtime.errors import InputError, one_line
from runtime.optics.stack import PanelStack, Tilt
from runtime.support import untrusted_input
from runtime.support.plausible import check_text, nearest, within
from runtime.support.plugins import located
from runtime.support.ranges import EYE_MOST_M, FOV_RANGE_DEG

TABLE_BYTES_MAX = 4 << 20  # of a TOML file


class Section(BaseModel):
    """A part of the file: frozen, unknown keys refused, numbers finite, texts that a path can hold."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    @field_validator("*", mode="before")
    @classmethod
    def _text(cls, value: Any) -> Any:
        return check_text(value) if isinstance(value, str) else value


M = TypeVar("M", bound=BaseModel)

MOST = 1e9  # of any number that has no narrower range
PIXEL_ASPECT_TOLERANCE = 0.03  # relative: data sheets round the active area
LEAST_GAP_M = 1e-5  # between panels: thinner than any panel
PANELS_MOST = 8  # of a stack

NonNegative = Annotated[float, Field(ge=0, le=MOST)]
Unit = Annotated[float, Field(ge=0, le=1)]
Entry = Annotated[float, Field(ge=-MOST, le=MOST)]  # of a matrix
Slope = Annotated[float, Field(ge=-0.2, le=0.2)]  # of a panel that should stand upright
Place = Annotated[float, within(-EYE_MOST_M, EYE_MOST_M, "m")]  # a coordinate of an eye
Offset = Annotated[float, within(-10.0, 10.0, "m")]  # of a scene
Turn = Annotated[float, within(-360.0, 360.0, "degrees")]


class StackGeometry(Section):
    """Geometry of the stack: what `--panels FILE` holds, and the `[stack]` table of the configuration."""

    width_m: Annotated[float, within(0.005, 20.0, "m")] = Field(
        0.5184, description="active width of every panel, metres"
    )
    height_m: Annotated[float, within(0.005, 20.0, "m")] = Field(
        0.2916, description="active height of every panel, metres"
    )
    x_m: Annotated[
        tuple[Annotated[float, within(-10.0, 10.0, "m")], ...], Field(min_length=2, max_length=PANELS_MOST)
    ] = Field((-0.06, 0.0, 0.06), description="panel positions along +x, rear to front, metres")
    width_px: Annotated[int, Field(ge=16, le=16384)] = Field(1920, description="columns of every panel")
    height_px: Annotated[int, Field(ge=16, le=16384)] = Field(1080, description="rows of every panel")
    pixel_aspect: Annotated[float, within(0.1, 10.0, "")] = Field(
        1.0, description="width of a pixel over its height; the configuration's sizes must agree with it to 3%"
    )

    tilt: Annotated[tuple[tuple[Slope, Slope], ...], Field(max_length=PANELS_MOST)] = Field(
        (),
        description="per panel, how much farther out it stands per metre to the viewer's right, and per metre up; "
        "written by `calibrate panels`; empty: the panels are parallel",
    )
    registered_from_m: tuple[Place, Place, Place] = Field(
        (0.5, 0.0, 0.0), description="where the homographies make tilted panels look parallel from, frame `stack`"
    )

    @model_validator(mode="after")
    def _tilted(self) -> StackGeometry:
        if len(self.tilt) not in (0, len(self.x_m)):
            raise ValueError(f"tilt: has {len(self.tilt)} panels, x_m has {len(self.x_m)}")
        if any(any(slopes) for slopes in self.tilt) and self.registered_from_m[0] <= self.x_m[-1]:
            raise ValueError("registered_from_m: is not before the front panel")
        return self

    @model_validator(mode="after")
    def _ascending(self) -> StackGeometry:
        gaps = [b - a for a, b in zip(self.x_m, self.x_m[1:], strict=False)]
        if any(gap <= 0 for gap in gaps):
            raise ValueError("x_m: must ascend from rear to front")
        if min(gaps) < LEAST_GAP_M:
            raise ValueError(f"x_m: panels {min(gaps):g} m apart are one panel; {LEAST_GAP_M:g} m is the least")
        return self

    def check_pixels(self) -> None:
        """Raise ValueError where the sizes in metres and in pixels do not make pixels of `pixel_aspect`."""
        found = (self.width_m / self.width_px) / (self.height_m / self.height_px)
        if abs(found / self.pixel_aspect - 1) > PIXEL_ASPECT_TOLERANCE:
            square_m = self.width_m / self.width_px * self.height_px / self.pixel_aspect
            raise ValueError(
                f"stack.height_m: {self.width_m:g} x {self.height_m:g} m of {self.width_px} x {self.height_px} pixels "
                f"have pixels {found:.3g} times as wide as high, not {self.pixel_aspect:g}: did you mean "
                f"height_m = {square_m:.4g}? (or set stack.pixel_aspect)"
            )

    def stack(self) -> PanelStack:
        """The geometry as a `PanelStack`."""
        tilt = None
        if any(any(slopes) for slopes in self.tilt):
            tilt = Tilt(tuple((0.0, right, up) for right, up in self.tilt), self.registered_from_m)
        return PanelStack(self.width_m, self.height_m, self.x_m, self.width_px, self.height_px, tilt)


class SensorSettings(Section):
    """The sensor that delivers eye positions or images."""

    driver: str = Field("replay", description="replay, openni2, usb-camera, fixed, or a class of yours: `module:Class`")
    source: str = Field("demo", description="what to open: a recording, `demo`, a serial number, a device URI")
    timeout_s: Annotated[float, within(0.001, 600.0, "s")] = Field(
        0.5, description="without a new sample for this long the sensor counts as stalled"
    )
    loop: bool = Field(False, description="driver `replay`: begin again at the end")
    openni2_folder: str = Field(
        "", description="driver `openni2`: folder of libOpenNI2.so and OpenNI2/Drivers; empty: the system's"
    )
    fov_deg: Annotated[float, Field(ge=0, lt=180)] = Field(
        0.0,
        description="horizontal field of view of a camera that does not report it (as usb-camera); 0: unknown",
    )
    fixed_eyes_m: tuple[tuple[Place, Place, Place], tuple[Place, Place, Place]] | None = Field(
        None, description="driver `fixed`: left and right eye in the stack frame; no sensor is opened"
    )
    options: dict[str, Any] = Field(
        default_factory=dict, description="options of a driver of your own, checked by its own model"
    )


class TrackerSettings(Section):
    """The tracker of the two eyes."""

    hold_s: Annotated[float, within(0.0, 60.0, "s")] = Field(
        0.5, description="hold the last eyes for this long after a loss, then go flat"
    )
    noise_m: Annotated[float, within(1e-6, 0.2, "m")] = Field(
        0.003, description="standard deviation per axis of an eye, for a sensor that does not report its own"
    )


class CalibrationSettings(Section):
    """The similarity from the sensor's frame to the stack's."""

    file: str = Field("", description="calibration TOML; empty: the built-in one of the demo recording")
    ipd_m: Annotated[float, within(0.04, 0.08, "m", zero=True)] = Field(
        0.0, description="the viewer's known eye separation, metres, 0: unknown; for charts, and cameras without depth"
    )
    viewing_m: tuple[Annotated[float, within(0.05, 20.0, "m")], Annotated[float, within(0.05, 20.0, "m")]] = Field(
        (0.4, 0.6), description="nearest and farthest viewer: charts and registration are for there"
    )
    viewing_side_deg: Annotated[float, Field(ge=2, le=40)] = Field(
        10.0, description="how far to either side viewers stand, seen from the display's middle"
    )
    viewing_up_deg: tuple[float, float] = Field((0.0, 20.0), description="how far up their eyes are: lowest, highest")

    @model_validator(mode="after")
    def _viewing(self) -> CalibrationSettings:
        if self.viewing_m[1] < self.viewing_m[0] * 1.1:
            raise ValueError("viewing_m: must be the nearest, then the farthest, at least a tenth farther")
        low, high = self.viewing_up_deg
        if not (-40 <= low < high <= 40 and high - low >= 2):
            raise ValueError("viewing_up_deg: must be lowest, then highest, between -40 and 40, 2 degrees apart")
        return self


LAYOUT = r"^(auto|mono|(half-)?side-by-side|(half-)?top-bottom|rgbd|qs\d{1,6}x\d{1,6}(a\d+(\.\d+)?)?)$"


class ContentSettings(Section):
    """The content."""

    scene: str = Field("demo", description="a built-in scene, a preset, a file or folder, or a class: `module:Class`")
    options: dict[str, Any] = Field(
        default_factory=dict, description="of a scene that is a class: its own settings; of `program`: port"
    )
    fov_deg: Annotated[float, within(*FOV_RANGE_DEG, "degrees")] = Field(
        40.0, description="horizontal field of view of eye images"
    )
    background: tuple[Unit, Unit, Unit] | None = Field(
        None, description="colour behind the scene, 0-1; without: dark, and white behind the built-in scenes"
    )
    file: str = Field("", description="a preset's data: its .ply or .glb, or its data-set folder")
    layout: Annotated[str, Field(pattern=LAYOUT)] = Field(
        "auto",
        description="how a picture or video holds its views: mono, side-by-side, top-bottom, half-side-by-side, "
        "half-top-bottom, rgbd or a quilt's qs8x6a0.75; auto: by its name (_sbs, _tb, _hsbs, _htb, _rgbd, _qs8x6a0.75)",
    )
    cone_deg: Annotated[float, Field(gt=0, lt=180)] = Field(40.0, description="angle that a quilt's views span")
    depth_m: tuple[Annotated[float, within(-10.0, 10.0, "m")], Annotated[float, within(-10.0, 10.0, "m")]] = Field(
        (-0.05, 0.05),
        description="rear and front, along x, of an RGBD picture or a fitted mesh, which may be twice as deep",
    )
    picture_rate_hz: Annotated[float, within(0.01, 1000.0, "Hz")] = Field(
        30.0, description="pictures a second of a folder of pictures"
    )
    fit: bool = Field(True, description="scale and centre a mesh or splat without a preset to the display")
    axes: Annotated[str, Field(pattern=r"^(auto|[+-][xyz] [+-][xyz])$")] = Field(
        "auto",
        description="the axes of a mesh or splats that are up and towards the viewer, as `+z -y`; auto: glTF's "
        "own, else guessed from the extent",
    )
    library: str = Field("", description="folder whose pictures, films, models and playlists the page offers")
    scale: Annotated[float, within(0.001, 1000.0, "")] = Field(
        1.0, description="scale factor of the scene, about the display's middle"
    )
    offset_m: tuple[Offset, Offset, Offset] = Field(
        (0.0, 0.0, 0.0), description="where the scene is moved: out of the screen, to the right, up; metres"
    )
    rotation_deg: tuple[Turn, Turn, Turn] = Field(
        (0.0, 0.0, 0.0),
        description="the scene's turns about the axes out of the screen, to the right and up, in this order",
    )
    turntable_per_min: Annotated[float, within(-600.0, 600.0, "turns a minute")] = Field(
        0.0, description="turns of the scene a minute about the vertical; negative: the other way; 0: none"
    )

    @model_validator(mode="after")
    def _ordered(self) -> ContentSettings:
        if self.depth_m[0] >= self.depth_m[1]:
            raise ValueError("depth_m: must be rear, then front")
        if self.axes != "auto" and self.axes[1] == self.axes[4]:
            raise ValueError("axes: must be two different ones")
        return self


def _today(name: Any) -> Any:
    """A backend's name; scripts still have the processor's old one."""
    return "cpu" if name == "opencv" else name


class ModelSettings(Section):
    """The phase network and where it runs."""

    name: str = Field("balanced", description="fast, balanced, best, sart, or an ONNX file with our contract")
    provider: Literal["cpu", "cuda", "tensorrt", "openvino"] = Field("cpu", description="execution provider")
    backend: Annotated[Literal["auto", "cpu", "gl"], BeforeValidator(_today)] = Field(
        "auto",
        description="what runs everything but the network: the processor, or OpenGL's shaders; "
        "auto: whichever is faster when both are measured at the start",
    )
    threads: Annotated[int, Field(ge=0, le=256)] = Field(2, description="inference threads; 0: all cores")
    eye_sigma_mm: Literal["auto"] | NonNegative = Field(
        "auto",
        description="tracking error that solutions allow for: standard deviation of the eyes' common place, "
        "millimetres an axis; 0: eyes known exactly; auto: the tracker's own",
    )
    budget_ms: NonNegative = Field(
        0.0, description="time for one solution, drawing included, after which no further step begins; 0: none"
    )


class PanelSettings(Section):
    """One physical panel: which monitor, how it is mounted, its grey curve. Rear to front."""

    edid_serial: str = Field("", description="monitor by EDID serial (first choice)")
    connector: str = Field("", description="monitor by connector name, as HDMI-1 (second choice)")
    rotation_deg: Literal[0, 90, 180, 270] = Field(0, description="how the panel is mounted, counter-clockwise")
    mirror: Literal["none", "horizontal", "vertical"] = Field("none", description="mirroring, before rotation")
    homography: tuple[tuple[Entry, Entry, Entry], tuple[Entry, Entry, Entry], tuple[Entry, Entry, Entry]] = Field(
        ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
        description="true panel pixels from ideal ones, 3x3, from `calibrate panels`",
    )
    lut: str = Field("", description="CSV of phase (0-1) and grey (0-1) per channel; empty: identity")
    gamma: Annotated[float, within(0.1, 10.0, "")] = Field(
        1.0, description="where there is no LUT: grey = phase^(1/gamma)"
    )


class OutputSettings(Section):
    """Output of the layers to panels."""

    kind: Literal["offscreen", "windows"] = Field("offscreen", description="EGL, or one fullscreen window a panel")
    panels: tuple[PanelSettings, ...] = Field(
        (), max_length=PANELS_MOST, description="one table a panel, rear to front"
    )


class LoopSettings(Section):
    """Pacing, and the stage costs of simulated time."""

    rate_hz: Annotated[float, within(1.0, 1000.0, "Hz")] = Field(
        60.0, description="refreshes a second, where the display does not report its own"
    )
    sensor_latency_ms: Annotated[float, within(0.0, 10_000.0, "ms")] = Field(
        15.0, description="from capture to arrival of a replayed sample"
    )
    scanout_ms: Annotated[float, within(0.0, 1000.0, "ms")] = Field(
        8.0, description="from the swap to the middle of the panel's light"
    )
    simulated_stage_ms: dict[str, NonNegative] = Field(
        default_factory=lambda: {
            "sensor": 0.1,
            "track": 0.1,
            "render": 8.0,
            "prepare": 4.0,
            "inference": 3.0,
            "finish": 8.0,
            "present": 2.0,
            "wait": 0.0,
        },
        description="what each stage costs on the simulated clock of --max-speed",
    )
    evaluate_every: Annotated[int, Field(ge=0)] = Field(
        20, description="with --out: measure what the eyes see every so many refreshes; 0: only at the last"
    )


class PlanSettings(Section):
    """Savings that are allowed."""

    enabled: bool = Field(
        True, description="skip what the scene and a resting head do not need; false: draw and solve everything"
    )
    align: bool = Field(True, description="shift and scale the panels at every refresh to where the eyes are then")


class ServiceSettings(Section):
    """The daemon's socket and black box."""

    socket: str = Field("/run/phasestack/status.sock", description="status and control socket")
    blackbox_minutes: Annotated[float, within(0.0, 60.0, "min")] = Field(
        2.0, description="minutes that the black box keeps in memory; 0: none"
    )


class Settings(Section):
    """All settings. `phasestack config` prints them."""

    stack: StackGeometry = Field(default_factory=StackGeometry, description="geometry of the panels")
    sensor: SensorSettings = Field(default_factory=SensorSettings, description="depth sensor")
    tracker: TrackerSettings = Field(default_factory=TrackerSettings, description="filter and prediction")
    calibration: CalibrationSettings = Field(default_factory=CalibrationSettings, description="sensor to stack")
    content: ContentSettings = Field(default_factory=ContentSettings, description="what is shown")
    model: ModelSettings = Field(default_factory=ModelSettings, description="phase network")
    output: OutputSettings = Field(default_factory=OutputSettings, description="panels")
    loop: LoopSettings = Field(default_factory=LoopSettings, description="pacing")
    plan: PlanSettings = Field(default_factory=PlanSettings, description="what is left out")
    service: ServiceSettings = Field(default_factory=ServiceSettings, description="socket, black box")

    @model_validator(mode="after")
    def _agree(self) -> Settings:
        self.stack.check_pixels()
        tables, panels = len(self.output.panels), len(self.stack.x_m)
        if tables not in (0, panels):
            raise ValueError(f"output.panels: has {tables} of {panels} tables: one a panel, rear to front")
        return self


def with_options(
    settings: Settings,
    *,
    replay: str | None = None,
    loop: bool = False,
    headless: bool = False,
    scene: str | None = None,
    model: str | None = None,
    backend: str | None = None,
) -> Settings:
    """The settings with what a command line says in force. Raises InputError, naming the option.

    loop: the replayed recording begins anew at its end.
    """
    given: tuple[tuple[str, str, dict[str, Any] | None], ...] = (
        ("--replay", "sensor", None if replay is None else {"driver": "replay", "source": replay}),
        ("--replay", "sensor", {"loop": True} if loop else None),
        ("--headless", "output", {"kind": "offscreen"} if headless else None),
        ("--scene", "content", None if scene is None else {"scene": scene}),
        ("--model", "model", None if model is None else {"name": model}),
        ("--backend", "model", None if backend is None else {"backend": backend}),
    )
    for option, section, values in given:
        if values is not None:
            settings = changed(settings, section, values, source=option)
    return settings


def changed(settings: Settings, section: str, values: dict[str, Any], *, source: str) -> Settings:
    """Settings with some values of one section replaced, checked. Raises InputError, naming `source`."""
    old: Section = getattr(settings, section)
    new = validated(type(old), old.model_dump() | values, source=source)
    return settings.model_copy(update={section: new})


KEY_PARTS_MAX = 16  # of a dotted key: tomllib takes the square of their number in time and memory
TEXTS = re.compile(
    r'''"""(?:[^\\]|\\.)*?"""|\'{3}.*?\'{3}|"(?:[^"\\\n]|\\.)*"|'[^'\n]*'|#[^\n]*''', re.DOTALL
)  # TOML's strings and comments
BESIDE_KEYS = re.compile(r"[\n=,{}\[\]]")


def read_table(path: Path) -> dict[str, Any]:
    """A TOML or JSON file as a table. Raises InputError, naming the file and the line of the mistake."""
    text = untrusted_input.read_text(path, most_bytes=TABLE_BYTES_MAX)
    if path.suffix.lower() == ".json":
        table = untrusted_input.parsed_json(text, source=path)
    else:
        plain = TEXTS.sub("_", text)
        # tomllib takes the square of a key's parts in time and memory.
        if max(key.count(".") for key in BESIDE_KEYS.split(plain)) >= KEY_PARTS_MAX:
            raise InputError(path, "", f"malformed: a key of more than {KEY_PARTS_MAX} parts")
        try:
            table = tomllib.loads(text)
        except ValueError as error:
            raise InputError(path, "", f"malformed: {error}") from None
        except RecursionError:
            raise InputError(path, "", "malformed: nested too deep") from None
    if not isinstance(table, dict):
        raise InputError(path, "", "must hold one table")
    return table


def validated(model: type[M], table: dict[str, Any], *, source: str | Path) -> M:
    """A table as validated settings. Raises InputError that names every wrong field."""
    try:
        return model.model_validate(table)
    except ValidationError as error:
        (name, problem), *others = dict(_wrong_field(model, each) for each in error.errors()).items()
        rest = [f"{field}: {one_line(text)}" if field else one_line(text) for field, text in others]
        raise InputError(source, name, "; ".join([one_line(problem), *rest])) from None


def _wrong_field(model: type[BaseModel], error: Any) -> tuple[str, str]:
    """The full name of a field that one of pydantic's errors is about, and what is wrong with it."""
    name = ".".join(str(part) for part in error["loc"])
    message = error["msg"].removeprefix("Value error, ")
    if error["type"] == "extra_forbidden":
        return name, "is no setting" + nearest(str(error["loc"][-1]), _fields(model, error["loc"][:-1]))
    field, colon, rest = message.partition(": ")
    if colon and error["type"] == "value_error" and field.partition(".")[0] in _fields(model, error["loc"]):
        return ".".join(filter(None, (name, field))), rest  # of a rule about several fields
    return name, message


def _fields(model: type[BaseModel], place: tuple[int | str, ...]) -> list[str]:
    """The keys that a table at a place of a model may have."""
    found: Any = model
    for part in place:
        if isinstance(part, str) and hasattr(found, "model_fields") and part in found.model_fields:
            kind = found.model_fields[part].annotation
            found = next((one for one in (kind, *getattr(kind, "__args__", ())) if hasattr(one, "model_fields")), kind)
    return list(getattr(found, "model_fields", ()))


# What is always a path, and what is one where it has a slash or a suffix: a bare word is a name (`demo`, `balanced`).
PATHS = (
    ("sensor", "openni2_folder"), ("calibration", "file"), ("content", "file"),
    ("content", "library"), ("service", "socket"),
)  # fmt: skip
NAMES_OR_PATHS = (("content", "scene"), ("model", "name"))


def _seen_from(folder: Path, table: dict[str, Any]) -> dict[str, Any]:
    """A configuration's table with its paths made absolute; what is no text is left for the validation to tell."""
    sections = {key: dict(value) if isinstance(value, dict) else value for key, value in table.items()}

    def place(section: Any, key: str, *, always: bool) -> None:
        value = section.get(key) if isinstance(section, dict) else None
        if isinstance(value, str) and Path(value).name not in ("", "..") and "\0" not in value:
            section[key] = str(folder / value) if always else located(value, folder)

    for name, key in PATHS:
        place(sections.get(name), key, always=True)
    for name, key in NAMES_OR_PATHS:
        place(sections.get(name), key, always=False)
    sensor = sections.get("sensor")
    if isinstance(sensor, dict):
        source, driver = sensor.get("source"), sensor.get("driver", "replay")
        # Other drivers' sources are serial numbers and URIs, with slashes of their own.
        if driver == "replay" or (isinstance(source, str) and source.endswith(".oni")):
            place(sensor, "source", always=source != "demo")
    output = sections.get("output")
    if isinstance(output, dict) and isinstance(output.get("panels"), list):
        output["panels"] = [dict(panel) if isinstance(panel, dict) else panel for panel in output["panels"]]
        for panel in output["panels"]:
            place(panel, "lut", always=True)
    return sections


def load_settings(path: Path | None) -> Settings:
    """Settings from a file (paths relative to its folder), or the defaults. Raises InputError."""
    if path is None:
        return Settings()
    return validated(Settings, _seen_from(path.absolute().parent, read_table(path)), source=path)


def load_stack(path: Path, *, width_px: int, height_px: int) -> PanelStack:
    """`--panels FILE`: geometry, with the images' size where the file gives none. Raises InputError."""
    table = {"width_px": width_px, "height_px": height_px} | read_table(path)
    for name in ("width_m", "height_m", "x_m"):
        if name not in table:
            hint = ": a configuration has it under [stack], a panels file at the top" if "stack" in table else ""
            raise InputError(path, name, f"is missing{hint}")
    if not 2 <= len(table["x_m"] if isinstance(table["x_m"], list) else ()) <= PANELS_MOST:
        raise InputError(path, "x_m", f"must list 2 to {PANELS_MOST} panels")
    return validated(StackGeometry, table, source=path).stack()
