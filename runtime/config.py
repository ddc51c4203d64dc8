"""One TOML file -> validated, frozen settings. Every default and its meaning is here.

Values are held to what a display can be built and run with, so that a wrong unit is told and not shown. Paths in a
file are relative to the folder of the file.
"""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from runtime.errors import InputError
from runtime.optics.stack import PanelStack, Tilt
from runtime.support import foreign
from runtime.support.live import LIVE
from runtime.support.plausible import check_text, nearest, socket_path, within
from runtime.support.ranges import EYE_MOST_M, FOV_RANGE_DEG, RECORD_MOST_S

TABLE_BYTES_MAX = 4 << 20


class Section(BaseModel):
    """A part of the file: frozen, unknown keys refused, numbers finite, texts that a path can hold."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    @field_validator("*", mode="before")
    @classmethod
    def _text(cls, value: Any) -> Any:
        return check_text(value) if isinstance(value, str) else value


S = TypeVar("S", bound=Section)

MOST = 1e9  # of any number that has no narrower range
PIXEL_ASPECT_TOLERANCE = 0.03
LEAST_GAP_M = 1e-5
PANELS_MOST = 8  # of a stack

Positive = Annotated[float, Field(gt=0, le=MOST)]
NonNegative = Annotated[float, Field(ge=0, le=MOST)]
Unit = Annotated[float, Field(ge=0, le=1)]
SocketPath = Annotated[str, AfterValidator(socket_path)]
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
        "written by `calibrate panels photo`; empty: the panels are parallel",
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
        """The geometry as optics wants it."""
        tilt = None
        if any(any(slopes) for slopes in self.tilt):
            tilt = Tilt(tuple((0.0, right, up) for right, up in self.tilt), self.registered_from_m)
        return PanelStack(self.width_m, self.height_m, self.x_m, self.width_px, self.height_px, tilt)


class SensorSettings(Section):
    """Which depth sensor delivers eye positions or images."""

    driver: str = Field("replay", description="driver name: replay, openni2, usb-eyes, fixed, or one registered")
    source: str = Field("demo", description="what to open: a recording, `demo`, a serial number, a device URI")
    timeout_s: Annotated[float, within(0.001, 600.0, "s")] = Field(
        0.5, description="without a new sample for this long the sensor counts as stalled"
    )
    reopen_backoff_s: Annotated[float, within(0.001, 600.0, "s")] = Field(
        0.25, description="first wait before a lost sensor is reopened; doubles"
    )
    reopen_backoff_max_s: Annotated[float, within(0.001, 600.0, "s")] = Field(
        0.5, description="longest wait between attempts"
    )
    open_timeout_s: Annotated[float, within(0.001, 600.0, "s")] = Field(
        10.0, description="an SDK that takes longer to open is given up and opened anew"
    )
    loop: bool = Field(False, description="driver `replay`: begin again at the end")
    start_s: Annotated[float, within(0.0, 604_800.0, "s")] = Field(
        0.0, description="driver `replay`: begin this far into the recording"
    )
    openni2_folder: str = Field(
        "", description="driver `openni2`: folder of libOpenNI2.so and OpenNI2/Drivers; empty: the system's"
    )
    fov_deg: Annotated[float, Field(ge=0, lt=180)] = Field(
        0.0, description="driver `openni2`: horizontal field of view of a camera that does not tell; 0: unknown"
    )
    record_max_s: Annotated[float, within(0.01, RECORD_MOST_S, "s")] = Field(
        600.0, description="`record` stops after this"
    )
    record_max_mib: Positive = Field(2048.0, description="`record` stops before its file is larger")
    fixed_eyes_m: tuple[tuple[Place, Place, Place], tuple[Place, Place, Place]] | None = Field(
        None, description="driver `fixed`: left and right eye in the stack frame; no sensor is opened"
    )


class DetectorSettings(Section):
    """Finding two eyes in colour and depth images. How far apart eyes may be is the tracker's business."""

    kind: Literal["haar", "yunet"] = Field("haar", description="face finder: bundled cascades, or OpenCV's YuNet")
    yunet_model: str = Field("", description="path of face_detection_yunet_*.onnx, for kind = yunet")
    range_min_m: Annotated[float, within(0.01, 20.0, "m")] = Field(
        0.2, description="nearer measurements are not a viewer's face"
    )
    range_max_m: Annotated[float, within(0.01, 20.0, "m")] = Field(
        4.0, description="farther measurements are not a viewer's face"
    )
    lock_s: Annotated[float, within(0.001, 600.0, "s")] = Field(
        0.3, description="a viewer not seen for this long makes way for another; less than tracker.hold_s"
    )

    @model_validator(mode="after")
    def _ordered(self) -> DetectorSettings:
        if self.range_min_m >= self.range_max_m:
            raise ValueError(f"range_min_m: {self.range_min_m:g} m is not below range_max_m ({self.range_max_m:g} m)")
        return self


class TrackerSettings(Section):
    """Gating, filtering and prediction of the two eyes."""

    horizon_max_s: Annotated[float, within(0.0, 1.0, "s")] = Field(
        0.12, description="never predict further ahead than this"
    )
    hold_s: Annotated[float, within(0.0, 60.0, "s")] = Field(
        0.5, description="hold the last eyes for this long after a loss, then go flat"
    )
    blend_s: Annotated[float, within(0.0, 60.0, "s")] = Field(
        0.3, description="time to blend to the flat picture and back"
    )
    ipd_min_m: Annotated[float, within(0.001, 0.2, "m")] = Field(
        0.050, description="smaller eye separations are implausible for a person"
    )
    ipd_max_m: Annotated[float, within(0.001, 0.2, "m")] = Field(
        0.075, description="larger eye separations are implausible for a person"
    )
    noise_m: Annotated[float, within(1e-6, 0.2, "m")] = Field(
        0.003, description="the sensor's noise on an eye, standard deviation of an axis"
    )
    acceleration: tuple[Positive, ...] = Field(
        (0.01, 0.1, 0.5),
        min_length=1,
        max_length=4,
        description="how freely a calm, a moving and a hasty head start and stop: noise density, m²/s³, ascending",
    )
    stay_s: Annotated[float, within(0.01, 600.0, "s")] = Field(
        1.0, description="how long a head keeps being calm, moving or hasty, on average"
    )
    turn_acceleration: Positive = Field(0.0003, description="the same of half the line between the eyes, m²/s³")
    speed_max: Annotated[float, within(0.05, 50.0, "m/s")] = Field(
        2.0, description="faster heads, in m/s, are outliers until a second sample confirms"
    )
    confidence_min: Unit = Field(0.3, description="less certain samples (a blink) are not used")
    loss_s: Annotated[float, within(0.0, 60.0, "s")] = Field(
        0.2, description="without any sample for this long the eyes are held, not predicted"
    )
    decay_s: Annotated[float, within(0.001, 60.0, "s")] = Field(
        0.06, description="time constant with which a lost head comes to rest"
    )
    revive_s: Annotated[float, within(0.001, 60.0, "s")] = Field(
        0.06, description="time in which the picture slides to eyes that were lost and found"
    )

    @model_validator(mode="after")
    def _ordered(self) -> TrackerSettings:
        if self.ipd_min_m >= self.ipd_max_m:
            raise ValueError(f"ipd_min_m: {self.ipd_min_m:g} m is not below ipd_max_m ({self.ipd_max_m:g} m)")
        return self


class CalibrationSettings(Section):
    """The similarity from the sensor's frame to the stack's."""

    file: str = Field("", description="calibration TOML; empty: the built-in one of the demo recording")
    ipd_m: Annotated[float, within(0.04, 0.08, "m", zero=True)] = Field(
        0.0, description="the viewer's known eye separation, metres, 0: unknown; checks for drift"
    )
    ipd_sigma_m: Annotated[float, within(0.0001, 0.02, "m")] = Field(
        0.001,
        description="how exactly ipd_m is known (a standard deviation): `calibrate solve` learns the scale from it",
    )
    ipd_tolerance: Positive = Field(0.04, description="warn where the measured one parts by more than this share")
    viewing_m: tuple[Annotated[float, within(0.05, 20.0, "m")], Annotated[float, within(0.05, 20.0, "m")]] = Field(
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


Layout = Literal["auto", "mono", "side-by-side", "half-side-by-side", "top-bottom", "half-top-bottom", "quilt", "rgbd"]


class ContentSettings(Section):
    """What is shown."""

    scene: str = Field("demo", description="a preset's name, `demo`, or a file or folder")
    reading: Literal["seed", "published-code", "published-training"] = Field(
        "seed", description="how a preset's d_thick is read, and where its panels stand"
    )
    fov_deg: Annotated[float, within(*FOV_RANGE_DEG, "degrees")] = Field(
        40.0, description="horizontal field of view of eye images"
    )
    background: tuple[Unit, Unit, Unit] = Field((1.0, 1.0, 1.0), description="colour behind the scene, 0-1")
    file: str = Field("", description="a preset's data: its .ply or .glb, or its data-set folder; empty: a stand-in")
    layout: Layout = Field(
        "auto",
        description="how a picture or video holds its views; auto: by its name (_sbs, _hsbs, _tb, _htb, _qs8x6, _rgbd)",
    )
    quilt: tuple[int, int] = Field((0, 0), description="columns and rows of a quilt; 0, 0: from the file's name")
    cone_deg: Annotated[float, Field(gt=0, lt=180)] = Field(40.0, description="angle that a quilt's views span")
    depth_m: tuple[Annotated[float, within(-10.0, 10.0, "m")], Annotated[float, within(-10.0, 10.0, "m")]] = Field(
        (-0.05, 0.05), description="rear and front between which an RGBD picture or a fitted mesh lies, along x"
    )
    picture_rate_hz: Annotated[float, within(0.01, 1000.0, "Hz")] = Field(
        30.0, description="pictures a second of a folder of pictures"
    )
    at_end: Literal["repeat", "hold"] = Field("repeat", description="what a video does at its end")
    fit: bool = Field(True, description="scale and centre a mesh or splat without a preset to the display")
    up: Literal["auto", "+x", "-x", "+y", "-y", "+z", "-z"] = Field(
        "auto", description="the axis of a mesh or splat that is up; auto: +y, for PLY +z (see `out`)"
    )
    out: Literal["auto", "+x", "-x", "+y", "-y", "+z", "-z"] = Field(
        "auto", description="the axis of a mesh or splat that faces the viewer; auto: +z, for PLY +x"
    )
    animation: str = Field(
        "", description="which animation of a glTF plays: its name or number (from 0), `none`; empty: the first"
    )
    samples: Annotated[int, Field(ge=0, le=16)] = Field(
        0, description="samples a pixel for outlines; 0: smooth outlines that a software rasteriser draws faster"
    )
    external: SocketPath = Field("/run/phasestack/content.sock", description="socket of another program's pictures")
    library: str = Field("", description="folder whose pictures, films, models and playlists the page offers")
    stream_options: dict[str, str] = Field(
        default_factory=dict,
        description="for live pictures, as FFmpeg names them: video_size, framerate, input_format, rtsp_transport, ...",
    )
    scale: Annotated[float, within(0.001, 1000.0, "")] = Field(
        1.0, description="the scene's size, times its own, about the display's middle"
    )
    offset_m: tuple[Offset, Offset, Offset] = Field(
        (0.0, 0.0, 0.0), description="where the scene is moved: out of the screen, to the right, up; metres"
    )
    rotation_deg: tuple[Turn, Turn, Turn] = Field(
        (0.0, 0.0, 0.0),
        description="the scene's turns about the axes out of the screen, to the right and up, in this order",
    )
    turntable_per_min: Annotated[float, within(-600.0, 600.0, "turns a minute")] = Field(
        0.0, description="the scene turns about the vertical so often a minute; negative: the other way; 0: it stands"
    )

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
    backend: Literal["auto", "opencv", "gl"] = Field(
        "auto",
        description="what does all that surrounds the network: OpenCV on the processor, or OpenGL's shaders; "
        "auto: both are measured at the start, and the faster one is taken",
    )
    threads: Annotated[int, Field(ge=0, le=256)] = Field(2, description="inference threads; 0: all cores")
    eye_sigma_mm: Literal["auto"] | NonNegative = Field(
        "auto",
        description="standard deviation of where light enters an eye, millimetres an axis: a picture for two points "
        "(0) or a forgiving one; auto: the pupil and the tracker's own covariance together",
    )
    pupil_mm: Annotated[float, within(0.0, 20.0, "mm")] = Field(
        4.0, description="diameter of a pupil, millimetres, for eye_sigma_mm = auto"
    )
    budget_ms: NonNegative = Field(0.0, description="time for one frame; 0: none. Picks model and resolution")


class PanelSettings(Section):
    """One physical panel: which monitor, how it is mounted, its grey curve. Rear to front."""

    edid_serial: str = Field("", description="monitor by EDID serial (first choice)")
    connector: str = Field("", description="monitor by connector name, as HDMI-1 (second choice)")
    index: Annotated[int, Field(ge=-1)] = Field(-1, description="monitor by explicit index (last choice); -1: none")
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

    def same_monitor(self, other: PanelSettings) -> str:
        """What names one monitor for both; empty where they can be two. Monitors may share their EDID serial."""
        if self.connector and self.connector == other.connector:
            return f"connector {self.connector}"
        if self.index >= 0 and self.index == other.index:
            return f"index {self.index}"
        alone = not (self.connector or other.connector or self.index >= 0 or other.index >= 0)
        if alone and self.edid_serial and self.edid_serial == other.edid_serial:
            return f"edid_serial {self.edid_serial}"
        return ""


class OutputSettings(Section):
    """How layers leave the machine."""

    kind: Literal["offscreen", "windows", "span"] = Field(
        "offscreen", description="EGL, one window a panel, or one window"
    )
    vsync: bool = Field(True, description="wait for the vertical blank")
    panels: tuple[PanelSettings, ...] = Field(
        (), max_length=PANELS_MOST, description="one table a panel, rear to front"
    )
    allow_rescaling: bool = Field(
        False, description="let a monitor whose mode has other pixels than the stack rescale the phases"
    )

    @model_validator(mode="after")
    def _each_its_own_monitor(self) -> OutputSettings:
        for number, panel in enumerate(self.panels):
            for before, other in enumerate(self.panels[:number]):
                if shared := panel.same_monitor(other):
                    raise ValueError(f"panels.{number}: is bound to the monitor of panels.{before} ({shared})")
        return self


class LoopSettings(Section):
    """Pacing, and the stage costs of simulated time."""

    rate_hz: Annotated[float, within(1.0, 1000.0, "Hz")] = Field(
        60.0, description="refreshes a second, where the display does not tell its own"
    )
    sensor_latency_ms: Annotated[float, within(0.0, 10_000.0, "ms")] = Field(
        15.0, description="from capture to arrival of a replayed sample"
    )
    scanout_ms: Annotated[float, within(0.0, 1000.0, "ms")] = Field(
        8.0, description="from the swap to the middle of the panel's light"
    )
    solver_late_s: Annotated[float, within(0.001, 600.0, "s")] = Field(
        0.5, description="a solution that takes longer is told as missing"
    )
    solver_abandon_s: Annotated[float, within(0.01, 3600.0, "s")] = Field(
        10.0, description="a solver that does not answer for so long is left behind and made anew"
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
        20, description="with --out: every so many refreshes, measure what the eyes see; 0: the last only"
    )


class PlanSettings(Section):
    """What may be left out; each saving can be switched off."""

    enabled: bool = Field(True, description="switches every saving at once")
    reuse: bool = Field(True, description="present again while neither content nor eyes moved")
    focus: bool = Field(True, description="run the network only where the two eyes' pictures differ")
    one_channel: bool = Field(True, description="solve one channel instead of three while the pictures are grey")
    one_eye: bool = Field(True, description="solve for one eye alone while the other can't see the display")
    align: bool = Field(True, description="shift and scale the panels at every refresh to where the eyes are then")
    dead_band_mm: NonNegative = Field(
        0.0, description="eye motion that is not solved for anew; 0: only while the head rests"
    )
    most_band_mm: NonNegative = Field(1.0, description="a resting head may drift so far until its place is renewed")
    range_deg: Annotated[float, Field(gt=0, le=90)] = Field(
        80.0, description="an eye farther off the display's axis than this can't see it"
    )


class LimitSettings(Section):
    """What a file from outside may hold: more is refused with its figure, before memory is taken for it."""

    file_mib: Annotated[float, Field(gt=0, le=1_000_000)] = Field(
        1024.0, description="one file of content or of a recording, MiB"
    )
    pixels: Annotated[int, Field(ge=1)] = Field(134_217_728, description="pixels of one picture; 16384 x 8192")
    triangles: Annotated[int, Field(ge=1)] = Field(2_000_000, description="triangles of a mesh, all instances together")
    splats: Annotated[int, Field(ge=1)] = Field(3_000_000, description="Gaussians of a splat file")
    instances: Annotated[int, Field(ge=1)] = Field(2000, description="times that meshes stand in a glTF scene")
    nodes: Annotated[int, Field(ge=1)] = Field(5000, description="nodes of a glTF scene that moves, bones among them")
    points: Annotated[int, Field(ge=1)] = Field(5_000_000, description="points of a cloud")
    depth: Annotated[int, Field(ge=1, le=512)] = Field(64, description="how deep JSON or a glTF scene may nest")
    load_s: Annotated[float, within(0.01, 86_400.0, "s")] = Field(
        120.0, description="loading of one piece of content is given up after this"
    )
    start_s: Annotated[float, within(1.0, 86_400.0, "s")] = Field(
        600.0, description="a start is given up where content and model are not ready after this"
    )
    recording_s: Annotated[float, Field(gt=0, le=1_000_000)] = Field(
        21_600.0, description="length of a recording that is replayed, seconds"
    )
    chunk_mib: Annotated[float, Field(gt=0, le=4096)] = Field(
        32.0, description="one chunk or message of a recording, unpacked, MiB"
    )


class ServiceSettings(Section):
    """The daemon's socket, metrics and logs."""

    socket: SocketPath = Field("/run/phasestack/status.sock", description="status and control socket")
    group: str = Field("phasestack", description="group that may use the socket")
    metrics_port: Annotated[int, Field(ge=0, le=65535)] = Field(0, description="Prometheus on loopback; 0: off")
    log_format: Literal["text", "json"] = Field("text", description="log lines for people or for machines")
    log_level: Literal["debug", "info", "warning", "error"] = Field("info", description="least level that is logged")
    blackbox_minutes: Annotated[float, within(0.0, 60.0, "min")] = Field(
        2.0, description="what the black box keeps in memory, to be written at a fault or by `ctl blackbox`; 0: none"
    )
    blackbox_mib: Annotated[float, within(1.0, 4096.0, "MiB")] = Field(
        32.0, description="the black box keeps no more than this in memory"
    )
    blackbox_folder: str = Field(
        "", description="where black boxes are written; empty: `blackbox` in the service's or the person's state folder"
    )
    blackbox_files: Annotated[int, Field(ge=1, le=1000)] = Field(
        10, description="black boxes that stay in the folder; the oldest make way"
    )


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
    limits: LimitSettings = Field(default_factory=LimitSettings, description="what files from outside may hold")

    @model_validator(mode="after")
    def _agree(self) -> Settings:
        self.stack.check_pixels()
        tables, panels = len(self.output.panels), len(self.stack.x_m)
        if tables not in (0, panels):
            raise ValueError(f"output.panels: has {tables} of {panels} tables: one a panel, rear to front")
        return self


class Overrides(BaseModel):
    """What the command line says instead of the configuration; checked where it is applied."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    replay: str | None = None
    headless: bool = False
    scene: str | None = None
    model: str | None = None
    budget_ms: float | None = None
    backend: str | None = None

    def applied(self, settings: Settings) -> Settings:
        """The settings with these in force. Raises InputError, naming the option."""
        if self.replay is not None:
            settings = changed(settings, "sensor", {"driver": "replay", "source": self.replay}, source="--replay")
        if self.headless:
            settings = changed(settings, "output", {"kind": "offscreen"}, source="--headless")
        if self.scene is not None:
            settings = changed(settings, "content", {"scene": self.scene}, source="--scene")
        if self.model is not None:
            settings = changed(settings, "model", {"name": self.model}, source="--model")
        if self.budget_ms is not None:
            settings = changed(settings, "model", {"budget_ms": self.budget_ms}, source="--budget-ms")
        if self.backend is not None:
            settings = changed(settings, "model", {"backend": self.backend}, source="--backend")
        return settings


def changed(settings: Settings, section: str, values: dict[str, Any], *, source: str) -> Settings:
    """Settings with some values of one section replaced, checked. Raises InputError, naming `source`."""
    old: Section = getattr(settings, section)
    new = validated(type(old), old.model_dump() | values, source=source)
    return settings.model_copy(update={section: new})


def read_table(path: Path) -> dict[str, Any]:
    """A TOML or JSON file as a table. Raises InputError, naming the file and the line of the mistake."""
    text = foreign.read_text(path, most_bytes=TABLE_BYTES_MAX)
    if path.suffix.lower() == ".json":
        table = foreign.parsed_json(text, source=path)
    else:
        try:
            table = tomllib.loads(text)
        except ValueError as error:
            raise InputError(path, "", f"malformed: {error}") from None
        except RecursionError:
            raise InputError(path, "", "malformed: nested too deep") from None
    if not isinstance(table, dict):
        raise InputError(path, "", "must hold one table")
    return table


def validated(model: type[S], table: dict[str, Any], *, source: str | Path) -> S:
    """A table as settings. Raises InputError with the first wrong field's full name, and what may have been meant."""
    try:
        return model.model_validate(table)
    except ValidationError as error:
        first = error.errors()[0]
        name = ".".join(str(part) for part in first["loc"])
        message = first["msg"].removeprefix("Value error, ")
        if first["type"] == "extra_forbidden":
            message = "is no setting" + nearest(str(first["loc"][-1]), _fields(model, first["loc"][:-1]))
        field, colon, rest = message.partition(": ")
        if colon and first["type"] == "value_error" and field.partition(".")[0] in _fields(model, first["loc"]):
            name, message = ".".join(filter(None, (name, field))), rest  # of a rule about several fields
        raise InputError(source, name, message) from None


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
    ("sensor", "openni2_folder"), ("detector", "yunet_model"), ("calibration", "file"), ("content", "file"),
    ("content", "library"),    ("content", "external"), ("service", "socket"), ("service", "blackbox_folder"),
)  # fmt: skip
NAMES_OR_PATHS = (("content", "scene"), ("model", "name"))


def located(name: str, folder: Path) -> str:
    """A name as it is; a path that is relative, seen from a folder. A bare word without a suffix is a name.

    What has a scheme (`rtsp://...`) is no path; what is shown as it comes (`live:FILE`) is one behind its mark.
    """
    if name.startswith(LIVE) and "://" not in name:
        return LIVE + located(name.removeprefix(LIVE), folder)
    if "://" in name:
        return name
    if not name or "\0" in name or not ("/" in name or Path(name).suffix):
        return name
    return str(folder / name)


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
    """Settings from a file, or the defaults without one; paths in it are relative to its folder. Raises InputError."""
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
