"""All settings, with their types, ranges, defaults and descriptions.

The ranges allow for any display that can be built, but rule out values given in the wrong unit. In that case, the error
message suggests the right unit.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field, ValidationInfo, field_validator, model_validator

from runtime.config.paths import NameOrPath, PathText, path_in
from runtime.kernels import MAX_PANELS
from runtime.optics.stack import PanelStack, Tilt
from runtime.records import STAGES
from runtime.support.plausible import nearest, within
from runtime.support.ranges import EYE_MOST_M, FOV_RANGE_DEG
from runtime.support.sections import Section

MOST = 1e9  # limit for numbers that have no narrower range
PIXEL_ASPECT_TOLERANCE = 0.03  # relative; data sheets give a rounded size for the active area
LEAST_GAP_M = 1e-5  # minimum distance between panels; real panels are all thicker
DEPTH_MOST = 10.0  # maximum distance from the rear to the front panel, relative to the longer side of a panel

NonNegative = Annotated[float, Field(ge=0, le=MOST)]
Unit = Annotated[float, Field(ge=0, le=1)]
Entry = Annotated[float, Field(ge=-MOST, le=MOST)]  # matrix element
Slope = Annotated[float, Field(ge=-0.2, le=0.2)]  # slope of a panel meant to be upright
Coordinate = Annotated[float, within(-EYE_MOST_M, EYE_MOST_M, "m")]  # eye coordinate
Point = tuple[Coordinate, Coordinate, Coordinate]
Offset = Annotated[float, within(-10.0, 10.0, "m")]  # scene displacement
Turn = Annotated[float, within(-360.0, 360.0, "degrees")]  # scene rotation


class StackGeometry(Section):
    """The stack's geometry, from `--panels FILE` or a configuration's `[stack]` table."""

    width_m: Annotated[float, within(0.005, 20.0, "m")] = Field(
        0.5184, description="width of each panel's active area in metres"
    )
    height_m: Annotated[float, within(0.005, 20.0, "m")] = Field(
        0.2916, description="height of each panel's active area in metres"
    )
    x_m: Annotated[
        tuple[Annotated[float, within(-10.0, 10.0, "m")], ...], Field(min_length=2, max_length=MAX_PANELS)
    ] = Field((-0.06, 0.0, 0.06), description="x coordinates of the panels in metres, from rear to front")
    width_px: Annotated[int, Field(ge=16, le=16384)] = Field(1920, description="width of each panel in pixels")
    height_px: Annotated[int, Field(ge=16, le=16384)] = Field(1080, description="height of each panel in pixels")
    pixel_aspect: Annotated[float, within(0.1, 10.0, "")] = Field(
        1.0, description="pixel width divided by pixel height (must match the sizes above to within 3%)"
    )

    tilt: tuple[tuple[Slope, Slope], ...] = Field(
        (),
        description="tilt of each panel, given as the slope of x to the viewer's right and upwards, as measured by "
        "`calibrate panels` (leave empty if the panels are parallel)",
    )
    colour: tuple[bool, ...] = Field(
        (),
        description="for each panel from rear to front, whether it has colour filters; a panel without them is 3 to 6 "
        "times as bright, and shows one value for all three colours (leave empty if all panels have filters)",
    )
    registered_from_m: Point = Field(
        (0.5, 0.0, 0.0), description="eye position (in the stack frame) from which the registered panels look parallel"
    )

    @model_validator(mode="after")
    def _tilted(self) -> StackGeometry:
        if len(self.tilt) not in (0, len(self.x_m)):
            raise ValueError(f"tilt: must have {len(self.x_m)} entries (one per panel), but has {len(self.tilt)}")
        if any(any(slopes) for slopes in self.tilt) and self.registered_from_m[0] <= self.x_m[-1]:
            raise ValueError("registered_from_m: must be in front of the front panel")
        return self

    @model_validator(mode="after")
    def _coloured(self) -> StackGeometry:
        if len(self.colour) not in (0, len(self.x_m)):
            raise ValueError(f"colour: must have {len(self.x_m)} entries (one per panel), but has {len(self.colour)}")
        return self

    @model_validator(mode="after")
    def _ascending(self) -> StackGeometry:
        gaps = [b - a for a, b in zip(self.x_m, self.x_m[1:], strict=False)]
        if any(gap <= 0 for gap in gaps):
            raise ValueError("x_m: must increase from rear to front")
        if min(gaps) < LEAST_GAP_M:
            raise ValueError(f"x_m: two panels are only {min(gaps):g} m apart, but the minimum is {LEAST_GAP_M:g} m")
        depth_m, side_m = self.x_m[-1] - self.x_m[0], max(self.width_m, self.height_m)
        if depth_m > DEPTH_MOST * side_m:
            meant = ", ".join(f"{x_m / 100:g}" for x_m in self.x_m)  # as if given in centimetres
            raise ValueError(
                f"x_m: the stack is {depth_m:g} m deep, but its panels are only {self.width_m:g} x "
                f"{self.height_m:g} m; did you mean [{meant}]?"
            )
        return self

    def check_pixels(self) -> None:
        """Raise ValueError if the sizes in metres and pixels do not agree with `pixel_aspect`."""
        aspect = (self.width_m / self.width_px) / (self.height_m / self.height_px)
        if abs(aspect / self.pixel_aspect - 1) > PIXEL_ASPECT_TOLERANCE:
            square_m = self.width_m / self.width_px * self.height_px / self.pixel_aspect
            raise ValueError(
                f"stack.height_m: {self.width_px} x {self.height_px} pixels on a panel of {self.width_m:g} x "
                f"{self.height_m:g} m give a pixel aspect of {aspect:.3g}, but stack.pixel_aspect is "
                f"{self.pixel_aspect:g}; did you mean height_m = {square_m:.4g}? Otherwise change stack.pixel_aspect"
            )

    def stack(self) -> PanelStack:
        """Return the geometry as a `PanelStack`."""
        tilt = None
        if any(any(slopes) for slopes in self.tilt):
            tilt = Tilt(tuple((0.0, right, up) for right, up in self.tilt), self.registered_from_m)
        colour = () if all(self.colour) else self.colour
        return PanelStack(self.width_m, self.height_m, self.x_m, self.width_px, self.height_px, tilt, colour)


class SensorSettings(Section):
    """The sensor, which delivers eye positions or images."""

    driver: str = Field(
        "replay", description="replay, openni2, realsense, usb-camera, fixed, or `module:Class` for your own class"
    )
    source: str = Field(
        "demo", description="recording, serial number or device URI to open, or `demo` for the built-in recording"
    )
    timeout_s: Annotated[float, within(0.001, 600.0, "s")] = Field(
        0.5, description="time to wait for a sample before treating the sensor as stalled"
    )
    loop: bool = Field(False, description="for the driver `replay`: restart the recording when it ends")
    openni2_folder: PathText = Field(
        "",
        description="for the driver `openni2`: folder that contains libOpenNI2.so and OpenNI2/Drivers (empty for "
        "the system's)",
    )
    fov_deg: Annotated[float, Field(ge=0, lt=180)] = Field(
        0.0, description="horizontal field of view for cameras that do not report one, such as webcams (0 if unknown)"
    )
    fixed_eyes_m: tuple[Point, Point] | None = Field(
        None, description="for the driver `fixed`: positions of the left and right eyes in the stack frame"
    )
    options: dict[str, Any] = Field(
        default_factory=dict, description="options for your own driver, validated by its `Options` class"
    )

    @field_validator("source")
    @classmethod
    def _resolve_source(cls, source: str, info: ValidationInfo) -> str:
        # With other drivers, the source is a serial number or URI, which may contain slashes.
        if info.data.get("driver") == "replay" or source.endswith((".oni", ".bag", ".db3")):
            return path_in(info.context, source, or_name=source == "demo")
        return source


TWO_VIEWERS_PANELS = 4  # minimum number of panels that serve two people well


class TrackerSettings(Section):
    """The tracker, which follows the viewer's eyes."""

    hold_s: Annotated[float, within(0.0, 60.0, "s")] = Field(
        0.5,
        description="time to keep using the last eye positions after the viewer is lost before switching to the "
        "flat picture",
    )
    noise_m: Annotated[float, within(1e-6, 0.2, "m")] = Field(
        0.003,
        description="standard deviation of measured eye positions on each axis, until it has been measured, for "
        "sensors that do not report it",
    )
    viewers: Literal[1, 2, "auto"] = Field(
        "auto",
        description="number of people served at the same time (auto: two from four panels on, otherwise one; two on "
        "three panels cost each person 6 dB)",
    )
    join_s: Annotated[float, within(0.0, 60.0, "s")] = Field(
        1.0, description="time that a second person must stay in view before being served as well"
    )


class CalibrationSettings(Section):
    """The viewing range, and the calibration that maps the sensor frame to the stack frame."""

    file: PathText = Field(
        "", description="calibration file in TOML format (leave empty to use the demo recording's calibration)"
    )
    ipd_m: Annotated[float, within(0.04, 0.08, "m", zero=True)] = Field(
        0.0,
        description="distance between the viewer's eyes, used for calibration charts and cameras without "
        "depth (0 if unknown)",
    )
    viewing_m: tuple[Annotated[float, within(0.05, 20.0, "m")], Annotated[float, within(0.05, 20.0, "m")]] = Field(
        (0.4, 0.6),
        description="distances to the nearest and farthest viewers, used for calibration charts and registration",
    )
    viewing_side_deg: Annotated[float, Field(ge=2, le=40)] = Field(
        10.0, description="maximum horizontal viewing angle to either side, measured at the display's centre"
    )
    viewing_up_deg: tuple[float, float] = Field(
        (0.0, 20.0), description="lowest and highest elevation angles of the viewers' eyes"
    )

    @model_validator(mode="after")
    def _viewing(self) -> CalibrationSettings:
        if self.viewing_m[1] < self.viewing_m[0] * 1.1:
            raise ValueError("viewing_m: must be two distances that differ by at least 10%, the nearer first")
        low, high = self.viewing_up_deg
        if not (-40 <= low < high <= 40 and high - low >= 2):
            raise ValueError(
                "viewing_up_deg: must be two angles between -40 and 40 degrees that are at least 2 degrees apart, the "
                "lower first"
            )
        return self


LAYOUT = (
    r"^(auto|mono|(half-)?(side-by-side|top-bottom|cross-eyed)|anaglyph|rgbd|qs\d{1,6}x\d{1,6}(a(\d+(\.\d+)?|\.\d+))?)$"
)
# Settings that place the content, changed by `phasestack ctl place`. A playlist's entries do not inherit them, another
# scene resets them, and the status shows them.
PLACING = ("scale", "offset_m", "rotation_deg", "turntable_per_min", "convergence_m", "comfort_deg")


class ContentSettings(Section):
    """The content and its placement."""

    scene: NameOrPath = Field(
        "demo",
        min_length=1,
        description="a built-in scene, a preset, a file, a folder, or `module:Class` for your own class",
    )
    options: dict[str, Any] = Field(
        default_factory=dict, description="options for a scene given as a class (the scene `program` accepts `port`)"
    )
    fov_deg: Annotated[float, within(*FOV_RANGE_DEG, "degrees")] = Field(
        40.0, description="horizontal field of view of each eye's picture"
    )
    background: tuple[Unit, Unit, Unit] | None = Field(
        None,
        description="background colour as RGB values from 0 to 1 (default: white for built-in scenes, dark "
        "for all others)",
    )
    file: PathText = Field("", description="data for a preset: a .ply file, a .glb file or a data-set folder")
    layout: Annotated[str, Field(pattern=LAYOUT)] = Field(
        "auto",
        description="arrangement of the views: mono, [half-]side-by-side, [half-]top-bottom, [half-]cross-eyed (right "
        "view on the left), anaglyph, rgbd or a quilt such as qs8x6a0.75; auto detects it from the file's metadata or "
        "name",
    )
    cone_deg: Annotated[float, Field(gt=0, lt=180)] = Field(
        40.0, description="angle between the outermost views of a quilt"
    )
    depth_m: tuple[Annotated[float, within(-10.0, 10.0, "m")], Annotated[float, within(-10.0, 10.0, "m")]] = Field(
        (-0.05, 0.05),
        description="rear and front limits of an RGBD picture's depth; `fit` scales meshes to at most twice this range",
    )
    focus: Literal["off", "auto", "on"] = Field(
        "off",
        description="while the head is at rest, separate pictures for points of the pupils, so that eyes can focus in "
        "depth: `auto` for content known to lie between the panels, `on` for any that can be drawn from any place",
    )
    picture_rate_hz: Annotated[float, within(0.01, 1000.0, "Hz")] = Field(
        30.0, description="frame rate of a folder of pictures"
    )
    fit: bool = Field(
        True, description="scale and centre a mesh or splat to fit the display, unless it comes from a preset"
    )
    axes: Annotated[str, Field(pattern=r"^(auto|[+-][xyz] [+-][xyz])$")] = Field(
        "auto",
        description="axes of a mesh or splat that point up and towards the viewer, such as `+z -y`; auto follows the "
        "file format's convention or, if there is none, guesses from the model's extent",
    )
    library: PathText = Field("", description="folder of pictures, films, models and playlists to offer on the page")
    scale: Annotated[float, within(0.001, 1000.0, "")] = Field(
        1.0, description="factor by which to scale the scene about the display's centre"
    )
    offset_m: tuple[Offset, Offset, Offset] = Field(
        (0.0, 0.0, 0.0),
        description="offset of the scene in metres in the stack frame (out of the screen, to the right, up)",
    )
    rotation_deg: tuple[Turn, Turn, Turn] = Field(
        (0.0, 0.0, 0.0),
        description="rotations of the scene about the axes that point out of the screen, right and up, applied in "
        "that order",
    )
    convergence_m: Annotated[float, within(-0.1, 0.1, "m")] = Field(
        0.0,
        description="distance in metres by which a stereo picture's right view is moved to the right of its left view "
        "(positive: farther away)",
    )
    comfort_deg: Annotated[float, within(0.0, 10.0, "degrees")] = Field(
        0.0,
        description="largest angle by which the depth of a stereo picture, film, `window` or `pipe` may differ from "
        "the display's; its views are moved, and made smaller if necessary (0 for no limit)",
    )
    turntable_per_min: Annotated[float, within(-600.0, 600.0, "turns per minute")] = Field(
        0.0,
        description="rotation speed about the vertical axis in turns per minute (negative for clockwise as seen "
        "from above)",
    )

    @model_validator(mode="after")
    def _ordered(self) -> ContentSettings:
        if self.depth_m[0] >= self.depth_m[1]:
            raise ValueError("depth_m: must be the rear limit followed by the front limit")
        if self.axes != "auto" and self.axes[1] == self.axes[4]:
            raise ValueError("axes: must name two different axes")
        return self


class ModelSettings(Section):
    """The model, and the device to run it on."""

    name: NameOrPath = Field(
        "balanced", min_length=1, description="fast, balanced, best, sart, or an ONNX file exported by phasestack"
    )
    effort: Literal["auto", "full"] = Field(
        "auto",
        description="resolution and number of steps per solution: auto adapts both to the viewer's movement, and full "
        "always uses the panels' full resolution and all of the model's steps",
    )
    provider: Literal["cpu", "cuda", "tensorrt", "openvino"] = Field(
        "cpu", description="ONNX Runtime execution provider for the network"
    )
    backend: Literal["auto", "cpu", "gl"] = Field(
        "auto",
        description="device for everything except the network: cpu, gl (the GPU through OpenGL) or auto for the "
        "faster of the two, as measured at startup",
    )
    threads: Annotated[int, Field(ge=0, le=256)] = Field(
        2, description="number of inference threads (0 for one per core)"
    )
    eye_sigma_mm: Literal["auto"] | NonNegative = Field(
        "auto",
        description="tracking error that solutions allow for, as the standard deviation in mm on each axis of the "
        "error that both eyes share (0 for none, auto for the tracker's own estimate)",
    )
    budget_ms: NonNegative = Field(
        0.0,
        description="time limit per solution, including drawing; no new step is started once it has elapsed (0 "
        "for no limit)",
    )


class PanelSettings(Section):
    """One physical panel: its monitor, mounting and grey curve."""

    edid_serial: str = Field("", description="EDID serial number of the panel's monitor")
    connector: str = Field(
        "", description="connector of the monitor, such as HDMI-1 (if edid_serial is also set, both must match)"
    )
    rotation_deg: Literal[0, 90, 180, 270] = Field(0, description="counter-clockwise rotation of the panel as mounted")
    mirror: Literal["none", "horizontal", "vertical"] = Field(
        "none", description="mirroring of the panel, applied before rotation"
    )
    homography: tuple[tuple[Entry, Entry, Entry], tuple[Entry, Entry, Entry], tuple[Entry, Entry, Entry]] = Field(
        ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
        description="3x3 matrix that maps ideal to actual panel pixels, as measured by `calibrate panels`",
    )
    lut: PathText = Field(
        "", description="CSV file that maps phase (0-1) to grey (0-1) for each channel (leave empty to use `gamma`)"
    )
    gamma: Annotated[float, within(0.1, 10.0, "")] = Field(
        1.0, description="exponent of the grey curve if there is no LUT: grey = phase^(1/gamma)"
    )
    delay_ms: Annotated[float, within(0.0, 100.0, "ms")] = Field(
        0.0, description="how much later than `loop.scanout_ms` this panel shows a frame; its alignment allows for it"
    )


class OutputSettings(Section):
    """Output to the panels."""

    kind: Literal["offscreen", "windows"] = Field(
        "offscreen", description="offscreen for no windows, or windows for one fullscreen window per panel"
    )
    panels: tuple[PanelSettings, ...] = Field(
        (), max_length=MAX_PANELS, description="one table per panel, from rear to front"
    )


def _check_stages(cost_ms: dict[str, float]) -> dict[str, float]:
    for name in cost_ms:
        if name not in STAGES:
            raise ValueError(f"{name} is not a stage{nearest(name, STAGES)} (stages: {', '.join(STAGES)})")
    return cost_ms


class LoopSettings(Section):
    """Pacing of the display loop, and the simulated clock."""

    rate_hz: Annotated[float, within(1.0, 1000.0, "Hz")] = Field(
        60.0, description="refresh rate to assume for a display that does not report one"
    )
    sensor_latency_ms: Annotated[float, within(0.0, 10_000.0, "ms")] = Field(
        15.0, description="delay between the capture of a replayed sample and its arrival"
    )
    scanout_ms: Annotated[float, within(0.0, 1000.0, "ms")] = Field(
        8.0,
        description="delay from the buffer swap to the midpoint of the interval during which the panels show the "
        "frame, plus their response's time constant",
    )
    simulated_stage_ms: Annotated[dict[str, NonNegative], AfterValidator(_check_stages)] = Field(
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
        description="duration of each stage on the simulated clock (--max-speed)",
    )
    evaluate_every: Annotated[int, Field(ge=0)] = Field(
        20,
        description="with --out: measure quality every N refreshes (less often if needed to keep up in real time); 0 "
        "measures only the last refresh",
    )


class PlanSettings(Section):
    """Ways for the solver and the display loop to save work."""

    enabled: bool = Field(True, description="skip work that is unnecessary for the scene or while the head is at rest")
    align: bool = Field(True, description="shift and scale the panels' pictures at every refresh to follow the eyes")


class ServiceSettings(Section):
    """The daemon's socket and black box."""

    socket: PathText = Field("/run/phasestack/status.sock", description="path of the status and control socket")
    blackbox_minutes: Annotated[float, within(0.0, 60.0, "min")] = Field(
        2.0, description="minutes of history that the black box keeps in memory (0 to turn it off)"
    )


class PoseSettings(Section):
    """The head pose, sent as OpenTrack's UDP datagrams or by LSL."""

    port: Annotated[int, Field(ge=0, le=65535)] = Field(0, description="UDP port, usually 4242 (0 to send nothing)")
    host: str = Field("127.0.0.1", description="computer to send to, by default this one")
    lsl: Annotated[str, Field(max_length=100)] = Field(
        "", description="name of an LSL stream to send to the local network, such as phasestack (empty to send nothing)"
    )
    rate_hz: Annotated[float, within(1.0, 240.0, "Hz")] = Field(60.0, description="largest number of poses per second")
    smoothing_ms: Annotated[float, within(0.0, 1000.0, "ms")] = Field(
        20.0, description="time constant for smoothing the pose (0 for none)"
    )
    origin_m: tuple[float, float, float] = Field(
        (0.6, 0.0, 0.0), description="head position sent as 0: metres towards the viewer, to the viewer's right and up"
    )


class Settings(Section):
    """All settings, as printed by `phasestack config`."""

    stack: StackGeometry = StackGeometry()
    sensor: SensorSettings = SensorSettings()
    tracker: TrackerSettings = TrackerSettings()
    calibration: CalibrationSettings = CalibrationSettings()
    content: ContentSettings = ContentSettings()
    model: ModelSettings = ModelSettings()
    output: OutputSettings = OutputSettings()
    loop: LoopSettings = LoopSettings()
    plan: PlanSettings = PlanSettings()
    service: ServiceSettings = ServiceSettings()

    @property
    def most_viewers(self) -> int:
        """Number of people served at the same time: `tracker.viewers`, or as many as the panels serve well."""
        if self.tracker.viewers != "auto":
            return self.tracker.viewers
        return 2 if len(self.stack.x_m) >= TWO_VIEWERS_PANELS else 1

    @property
    def sought_people(self) -> int:
        """Number of people to look for in pictures: those served, and one who may pass between them."""
        return self.most_viewers + 1 if self.most_viewers > 1 else 1

    pose: PoseSettings = PoseSettings()

    @model_validator(mode="after")
    def _agree(self) -> Settings:
        self.stack.check_pixels()
        tables, panels = len(self.output.panels), len(self.stack.x_m)
        if tables not in (0, panels):
            raise ValueError(
                f"output.panels: must have {panels} tables (one per panel, from rear to front), but has {tables}"
            )
        return self
