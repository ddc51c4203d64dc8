"""One TOML file -> validated, frozen settings. Every default and its meaning is here."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from runtime.errors import InputError
from runtime.optics.stack import PanelStack


class Section(BaseModel):
    """A part of the file: frozen, unknown keys refused, numbers finite."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


S = TypeVar("S", bound=Section)

Positive = Annotated[float, Field(gt=0)]
NonNegative = Annotated[float, Field(ge=0)]
Unit = Annotated[float, Field(ge=0, le=1)]


class StackGeometry(Section):
    """Geometry of the stack: what `--panels FILE` holds, and the `[stack]` table of the configuration."""

    width_m: Positive = Field(0.5184, description="active width of every panel, metres")
    height_m: Positive = Field(0.2916, description="active height of every panel, metres")
    x_m: Annotated[tuple[float, ...], Field(min_length=2, max_length=8)] = Field(
        (-0.06, 0.0, 0.06), description="panel positions along +x, rear to front, metres"
    )
    width_px: Annotated[int, Field(ge=16, le=16384)] = Field(1920, description="columns of every panel")
    height_px: Annotated[int, Field(ge=16, le=16384)] = Field(1080, description="rows of every panel")

    @model_validator(mode="after")
    def _ascending(self) -> StackGeometry:
        if any(b <= a for a, b in zip(self.x_m, self.x_m[1:], strict=False)):
            raise ValueError("x_m: must ascend from rear to front")
        return self

    def stack(self) -> PanelStack:
        """The geometry as optics wants it."""
        return PanelStack(self.width_m, self.height_m, self.x_m, self.width_px, self.height_px)


class SensorSettings(Section):
    """Which depth sensor delivers eye positions or images."""

    driver: str = Field("replay", description="driver name: replay, openni2, usb-eyes, fixed, or one registered")
    source: str = Field("demo", description="what to open: a recording, `demo`, a serial number, a device URI")
    timeout_s: Positive = Field(0.5, description="without a new sample for this long the sensor counts as stalled")
    reopen_backoff_s: Positive = Field(0.25, description="first wait before a lost sensor is reopened; doubles")
    reopen_backoff_max_s: Positive = Field(0.5, description="longest wait between attempts")
    open_timeout_s: Positive = Field(10.0, description="an SDK that takes longer to open is given up and opened anew")
    loop: bool = Field(False, description="driver `replay`: begin again at the end")
    start_s: NonNegative = Field(0.0, description="driver `replay`: begin this far into the recording")
    openni2_folder: str = Field(
        "", description="driver `openni2`: folder of libOpenNI2.so and OpenNI2/Drivers; empty: the system's"
    )
    fov_deg: Annotated[float, Field(ge=0, lt=180)] = Field(
        0.0, description="driver `openni2`: horizontal field of view of a camera that does not tell; 0: unknown"
    )
    record_max_s: Positive = Field(600.0, description="`record` stops after this")
    record_max_mib: Positive = Field(2048.0, description="`record` stops before its file is larger")
    fixed_eyes_m: tuple[tuple[float, float, float], tuple[float, float, float]] | None = Field(
        None, description="driver `fixed`: left and right eye in the stack frame; no sensor is opened"
    )


class DetectorSettings(Section):
    """Finding two eyes in colour and depth images. How far apart eyes may be is the tracker's business."""

    kind: Literal["haar", "yunet"] = Field("haar", description="face finder: bundled cascades, or OpenCV's YuNet")
    yunet_model: str = Field("", description="path of face_detection_yunet_*.onnx, for kind = yunet")
    range_min_m: Positive = Field(0.2, description="nearer measurements are not a viewer's face")
    range_max_m: Positive = Field(4.0, description="farther measurements are not a viewer's face")
    lock_s: Positive = Field(1.0, description="a viewer who is not seen for this long makes way for another")


class TrackerSettings(Section):
    """Gating, filtering and prediction of the two eyes."""

    horizon_max_s: NonNegative = Field(0.12, description="never predict further ahead than this")
    hold_s: NonNegative = Field(0.5, description="hold the last eyes for this long after a loss, then go flat")
    blend_s: NonNegative = Field(0.3, description="time to blend to the flat picture and back")
    ipd_min_m: Positive = Field(0.050, description="smaller eye separations are implausible for a person")
    ipd_max_m: Positive = Field(0.075, description="larger eye separations are implausible for a person")
    noise_m: Positive = Field(0.003, description="the sensor's noise on an eye, standard deviation of an axis")
    acceleration: tuple[Positive, ...] = Field(
        (0.01, 0.1, 0.5),
        min_length=1,
        max_length=4,
        description="how freely a calm, a moving and a hasty head start and stop: noise density, m²/s³, ascending",
    )
    stay_s: Positive = Field(1.0, description="how long a head keeps being calm, moving or hasty, on average")
    turn_acceleration: Positive = Field(0.0003, description="the same of half the line between the eyes, m²/s³")
    speed_max: Positive = Field(2.0, description="faster heads, in m/s, are outliers until a second sample confirms")
    confidence_min: NonNegative = Field(0.3, description="less certain samples (a blink) are not used")
    loss_s: NonNegative = Field(0.2, description="without any sample for this long the eyes are held, not predicted")
    decay_s: Positive = Field(0.06, description="time constant with which a lost head comes to rest")
    revive_s: Positive = Field(0.06, description="time in which the picture slides to eyes that were lost and found")


class CalibrationSettings(Section):
    """The similarity from the sensor's frame to the stack's."""

    file: str = Field("", description="calibration TOML; empty: the built-in one of the demo recording")
    ipd_m: NonNegative = Field(0.0, description="the viewer's known eye separation, 0: unknown; checks for drift")
    ipd_tolerance: Positive = Field(0.04, description="warn where the measured one parts by more than this share")
    viewing_m: tuple[Positive, Positive] = Field(
        (0.4, 0.6), description="nearest and farthest viewer: charts and registration are for there"
    )
    viewing_side_deg: Annotated[float, Field(ge=2, le=40)] = Field(
        10.0, description="how far to either side viewers stand, seen from the display's middle"
    )
    viewing_up_deg: tuple[float, float] = Field((0.0, 20.0), description="how far up their eyes are: lowest, highest")
    scale_sigma: NonNegative = Field(
        0.02, description="how far off the sensor's metre may be, standard deviation; 0: it is exact"
    )

    @model_validator(mode="after")
    def _viewing(self) -> CalibrationSettings:
        if self.viewing_m[1] < self.viewing_m[0] * 1.1:
            raise ValueError("viewing_m: must be the nearest, then the farthest, at least a tenth farther")
        low, high = self.viewing_up_deg
        if not (-40 <= low < high <= 40 and high - low >= 2):
            raise ValueError("viewing_up_deg: must be lowest, then highest, between -40 and 40, 2 degrees apart")
        return self


class ContentSettings(Section):
    """What is shown."""

    scene: str = Field("demo", description="a preset's name, `demo`, or a file or folder")
    reading: Literal["seed", "published-code"] = Field("seed", description="how a preset's d_thick is read")
    fov_deg: Annotated[float, Field(gt=0, lt=180)] = Field(40.0, description="horizontal field of view of eye images")
    background: tuple[Unit, Unit, Unit] = Field((1.0, 1.0, 1.0), description="colour behind the scene, 0-1")
    file: str = Field("", description="a preset's data: its .ply or .glb, or its data-set folder; empty: a stand-in")
    layout: Literal["auto", "mono", "side-by-side", "top-bottom", "quilt", "rgbd"] = Field(
        "auto", description="how a picture or video holds its views; auto: by its name (_sbs, _tb, _qs8x6, _rgbd)"
    )
    quilt: tuple[int, int] = Field((0, 0), description="columns and rows of a quilt; 0, 0: from the file's name")
    cone_deg: Annotated[float, Field(gt=0, lt=180)] = Field(40.0, description="angle that a quilt's views span")
    depth_m: tuple[float, float] = Field(
        (-0.05, 0.05), description="rear and front between which an RGBD picture or a fitted mesh lies, along x"
    )
    picture_rate_hz: Positive = Field(30.0, description="pictures a second of a folder of pictures")
    at_end: Literal["repeat", "hold"] = Field("repeat", description="what a video does at its end")
    fit: bool = Field(True, description="scale and centre a mesh or splat without a preset to the display")
    up: Literal["auto", "+x", "-x", "+y", "-y", "+z", "-z"] = Field(
        "auto", description="the axis of a mesh or splat that is up; auto: +y, for PLY +z (see `out`)"
    )
    out: Literal["auto", "+x", "-x", "+y", "-y", "+z", "-z"] = Field(
        "auto", description="the axis of a mesh or splat that faces the viewer; auto: +z, for PLY +x"
    )
    samples: Annotated[int, Field(ge=0, le=16)] = Field(
        0, description="samples a pixel for outlines; 0: smooth outlines that a software rasteriser draws faster"
    )
    external: str = Field("/run/phasestack/content.sock", description="socket of another program's pictures")

    @model_validator(mode="after")
    def _ordered(self) -> ContentSettings:
        if self.depth_m[0] >= self.depth_m[1]:
            raise ValueError("depth_m: must be rear, then front")
        if (self.up == "auto") != (self.out == "auto") or (self.up != "auto" and self.up[1] == self.out[1]):
            raise ValueError("up and out: must be two different axes, or both auto")
        return self


class ModelSettings(Section):
    """The phase network and where it runs."""

    name: str = Field("balanced", description="fast, balanced, best, sart, or an ONNX file with our contract")
    provider: Literal["cpu", "cuda", "tensorrt", "openvino"] = Field("cpu", description="execution provider")
    threads: Annotated[int, Field(ge=0, le=256)] = Field(2, description="inference threads; 0: all cores")
    tolerance_mm: NonNegative = Field(
        1.0, description="how far off the eyes the picture should still hold: trades exactness against tolerance"
    )
    transfer: Literal["code", "srgb"] = Field("code", description="panel luminance: code values, or linear via sRGB")
    budget_ms: NonNegative = Field(0.0, description="time for one frame; 0: none. Picks model and resolution")


class PanelSettings(Section):
    """One physical panel: which monitor, how it is mounted, its grey curve. Rear to front."""

    edid_serial: str = Field("", description="monitor by EDID serial (first choice)")
    connector: str = Field("", description="monitor by connector name, as HDMI-1 (second choice)")
    index: Annotated[int, Field(ge=-1)] = Field(-1, description="monitor by explicit index (last choice); -1: none")
    rotation_deg: Literal[0, 90, 180, 270] = Field(0, description="how the panel is mounted, counter-clockwise")
    mirror: Literal["none", "horizontal", "vertical"] = Field("none", description="mirroring, before rotation")
    homography: tuple[tuple[float, float, float], ...] = Field(
        ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
        description="true panel pixels from ideal ones, 3x3, from `calibrate panels`",
    )
    lut: str = Field("", description="CSV of phase (0-1) and grey (0-1) per channel; empty: identity")
    gamma: Positive = Field(1.0, description="where there is no LUT: grey = phase^(1/gamma)")


class OutputSettings(Section):
    """How layers leave the machine."""

    kind: Literal["offscreen", "windows", "span"] = Field(
        "offscreen", description="EGL, one window a panel, or one window"
    )
    vsync: bool = Field(True, description="wait for the vertical blank")
    panels: tuple[PanelSettings, ...] = Field((), description="one table a panel, rear to front")


class LoopSettings(Section):
    """Pacing, and the stage costs of simulated time."""

    rate_hz: Positive = Field(60.0, description="turns per second at most")
    sensor_latency_ms: NonNegative = Field(15.0, description="from capture to arrival of a replayed sample")
    scanout_ms: NonNegative = Field(8.0, description="from the swap to the middle of the panel's light")
    simulated_stage_ms: dict[str, float] = Field(
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
        20, description="with --out: every so many frames, measure what the eyes see; 0: last frame only"
    )


class PlanSettings(Section):
    """What may be left out; each saving can be switched off."""

    enabled: bool = Field(True, description="switches every saving at once")
    reuse: bool = Field(True, description="present again while neither content nor eyes moved")
    focus: bool = Field(True, description="run the network only where the two eyes' pictures differ")
    one_channel: bool = Field(True, description="solve one channel instead of three while the pictures are grey")
    one_eye: bool = Field(True, description="solve for one eye alone while the other can't see the display")
    dead_band_mm: NonNegative = Field(
        0.0, description="eye motion that counts as none; 0: from the tracker's noise, at most model.tolerance_mm"
    )
    range_deg: Annotated[float, Field(gt=0, le=90)] = Field(
        80.0, description="an eye farther off the display's axis than this can't see it"
    )


class ServiceSettings(Section):
    """The daemon's socket, metrics and logs."""

    socket: str = Field("/run/phasestack/status.sock", description="status and control socket")
    group: str = Field("phasestack", description="group that may use the socket")
    metrics_port: Annotated[int, Field(ge=0, le=65535)] = Field(0, description="Prometheus on loopback; 0: off")
    log_format: Literal["text", "json"] = Field("text", description="log lines for people or for machines")
    log_level: Literal["debug", "info", "warning", "error"] = Field("info", description="least level that is logged")


class Settings(Section):
    """Everything. `phasestack config` prints it."""

    stack: StackGeometry = Field(default_factory=StackGeometry, description="geometry of the panels")
    sensor: SensorSettings = Field(default_factory=SensorSettings, description="depth sensor")
    detector: DetectorSettings = Field(default_factory=DetectorSettings, description="eyes from images")
    tracker: TrackerSettings = Field(default_factory=TrackerSettings, description="filter and prediction")
    calibration: CalibrationSettings = Field(default_factory=CalibrationSettings, description="sensor to stack")
    content: ContentSettings = Field(default_factory=ContentSettings, description="what is shown")
    model: ModelSettings = Field(default_factory=ModelSettings, description="phase network")
    output: OutputSettings = Field(default_factory=OutputSettings, description="panels")
    loop: LoopSettings = Field(default_factory=LoopSettings, description="pacing")
    plan: PlanSettings = Field(default_factory=PlanSettings, description="what is left out")
    service: ServiceSettings = Field(default_factory=ServiceSettings, description="socket, metrics, logs")


class Overrides(Section):
    """What the command line says instead of the configuration."""

    replay: str | None = None
    headless: bool = False
    scene: str | None = None
    model: str | None = None
    budget_ms: float | None = None

    def applied(self, settings: Settings) -> Settings:
        """The settings with these in force."""
        changes: dict[str, Any] = {}
        if self.replay is not None:
            changes["sensor"] = settings.sensor.model_copy(update={"driver": "replay", "source": self.replay})
        if self.headless:
            changes["output"] = settings.output.model_copy(update={"kind": "offscreen"})
        if self.scene is not None:
            changes["content"] = settings.content.model_copy(update={"scene": self.scene})
        model = {"name": self.model, "budget_ms": self.budget_ms}
        given = {key: value for key, value in model.items() if value is not None}
        if given:
            changes["model"] = settings.model.model_copy(update=given)
        return settings.model_copy(update=changes)


def read_table(path: Path) -> dict[str, Any]:
    """A TOML or JSON file as a table. Raises InputError, naming the file and the line of the mistake."""
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(path, "", f"cannot be read ({getattr(error, 'strerror', None) or error})") from None
    try:
        if path.suffix.lower() == ".json":
            import json

            table = json.loads(text)
        else:
            table = tomllib.loads(text)
    except ValueError as error:
        raise InputError(path, "", f"malformed: {error}") from None
    if not isinstance(table, dict):
        raise InputError(path, "", "must hold one table")
    return table


def validated(model: type[S], table: dict[str, Any], *, source: str | Path) -> S:
    """A table as settings. Raises InputError with the first wrong field's full name."""
    try:
        return model.model_validate(table)
    except ValidationError as error:
        first = error.errors()[0]
        name = ".".join(str(part) for part in first["loc"])
        message = first["msg"].removeprefix("Value error, ")
        raise InputError(source, name, message) from None


def load_settings(path: Path | None) -> Settings:
    """Settings from a file, or the defaults without one. Raises InputError."""
    return Settings() if path is None else validated(Settings, read_table(path), source=path)


def load_stack(path: Path, *, width_px: int, height_px: int) -> PanelStack:
    """`--panels FILE`: geometry, with the images' size where the file gives none. Raises InputError."""
    table = {"width_px": width_px, "height_px": height_px} | read_table(path)
    for name in ("width_m", "height_m", "x_m"):
        if name not in table:
            raise InputError(path, name, "is missing")
    if not 2 <= len(table["x_m"] if isinstance(table["x_m"], list) else ()) <= 4:
        raise InputError(path, "x_m", "must list 2 to 4 panels")
    return validated(StackGeometry, table, source=path).stack()
