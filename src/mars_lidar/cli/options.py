"""The options of `mars-lidar simulate`, each with its unit and default in its help."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

_SCENE, _SYSTEM = "Scene (one of --scene, --depth and --transient)", "System"
_EFFECTS = "Effects of the detector (off by default)"
_TRANSIENT = "Rendered transient (with --transient)"
_LIGHT, _RUN, _OUTPUT = "Light", "Simulation", "Output"


def _option(*names: str, panel: str, help: str, default: str | None = None, **more: Any) -> Any:
    told = help if default is None else f"{help} [dim]Default: {default}.[/dim]"
    return typer.Option(*names, rich_help_panel=panel, help=told, show_default=False, **more)


Out = Annotated[
    Path,
    _option(
        "-o", "--out", panel=_OUTPUT,
        help="The cube: .zarr (any size, written as it is simulated), .h5, .hdf5, .npz, .mat or .ptu.",
    ),
]
Scene = Annotated[str | None, _option("--scene", panel=_SCENE, help="A built-in scene: room.")]
Size = Annotated[
    int | None,
    _option(
        "--size", panel=_SCENE, min=1,
        help="Image size in pixels: square for --scene; the longer side, resampled, for --depth.",
        default="128 for --scene, the file's own for --depth",
    ),
]
SceneSeed = Annotated[
    int,
    _option("--scene-seed", panel=_SCENE, help="Arrangement of the built-in scene.", default="0"),
]
Depth = Annotated[
    Path | None,
    _option(
        "--depth", panel=_SCENE,
        help="Depth: 16-bit PNG or TIFF in mm, .pfm, .exr, .npy or .npz in m, NYUv2's .mat, or a Middlebury folder.",
    ),
]
Image = Annotated[
    Path | None,
    _option("--image", panel=_SCENE, help="Image to --depth: its luminance is the reflectivity."),
]
DepthUnitM = Annotated[
    float | None,
    _option(
        "--depth-unit-m", panel=_SCENE, help="Metres per stored unit of --depth.",
        default="0.001 for images, 1 for arrays",
    ),
]
FocalPx = Annotated[
    float | None,
    _option(
        "--focal-px", panel=_SCENE,
        help="Focal length, pixels: turns depth along the axis into range along the ray.",
        default="depth as it is",
    ),
]
Index = Annotated[
    int | None,
    _option("--index", panel=_SCENE, help="Frame of a NYUv2 .mat given as --depth, from 0."),
]
Transient = Annotated[
    Path | None,
    _option(
        "--transient", panel=_SCENE,
        help="Rendered transient (y, x, time), read in bands: .npy, .npz, .h5, .hdf5 (tal and mitransient too), .mat.",
    ),
]
TransientBinNs = Annotated[
    float | None,
    _option("--transient-bin-ns", panel=_TRANSIENT, help="Width of its time bins, ns.", default="what the file says"),
]
TransientStartNs = Annotated[
    float | None,
    _option(
        "--transient-start-ns", panel=_TRANSIENT, help="Travel time at its first bin, ns.",
        default="what the file says, else 0",
    ),
]
TransientName = Annotated[
    str | None,
    _option("--transient-name", panel=_TRANSIENT, help="Which array of the file.", default="transient"),
]
TransientChannel = Annotated[
    int | None,
    _option("--transient-channel", panel=_TRANSIENT, help="Which channel of a file (y, x, time, channel), from 0."),
]
TransientPulse = Annotated[
    bool | None,
    _option(
        "--transient-pulse/--no-transient-pulse", panel=_TRANSIENT, default="yes",
        help="Convolve with the system's pulse; no where the transient contains it already.",
    ),
]
PhotonsPerUnit = Annotated[
    float | None,
    _option(
        "--photons-per-unit", panel=_TRANSIENT,
        help="Instead of --signal: detectable photons per period for one unit of its light.",
    ),
]
System = Annotated[
    Path | None,
    _option(
        "--system", panel=_SYSTEM,
        help="YAML or JSON file (see mars-lidar init); single options replace its values.",
    ),
]
PeriodNs = Annotated[
    float | None,
    _option("--period-ns", panel=_SYSTEM, help="Laser period, ns.", default="133.33, 7.5 MHz"),
]
DetectorPreset = Annotated[
    str | None,
    _option(
        "--detector", panel=_SYSTEM,
        help="Detector by name, in place of the file's (docs/detectors.md): excelitas-spcm-aqrh.",
    ),
]
DeadTimeNs = Annotated[
    float | None,
    _option("--dead-time-ns", panel=_SYSTEM, help="Dead time after a registration, ns.", default="75"),
]
Mode = Annotated[
    str | None,
    _option(
        "--mode", panel=_SYSTEM, default="nonparalyzable",
        help="When the pixel registers: nonparalyzable, paralyzable (every arrival restarts the dead time), "
        "synchronous (armed at each pulse, first photon only) or gated (with --gate-start-ns, --gate-width-ns).",
    ),
]
GateStartNs = Annotated[
    float | None,
    _option("--gate-start-ns", panel=_SYSTEM, help="Mode gated: opening of the gate in each period, ns."),
]
GateWidthNs = Annotated[
    float | None,
    _option("--gate-width-ns", panel=_SYSTEM, help="Mode gated: width of the gate, at most the period, ns."),
]
GateStepNs = Annotated[
    float | None,
    _option("--gate-step-ns", panel=_SYSTEM, help="Mode gated: the opening advances by this, ns ...", default="0"),
]
GateCycles = Annotated[
    int | None,
    _option("--gate-cycles", panel=_SYSTEM, help="... every so many periods.", default="1"),
]
Cycles = Annotated[
    int | None,
    _option("--cycles", panel=_SYSTEM, help="Laser periods per exposure.", default="1000"),
]
Bins = Annotated[
    int | None,
    _option("--bins", panel=_SYSTEM, help="Histogram bins per period.", default="1024"),
]
PulseSigmaNs = Annotated[
    float | None,
    _option("--pulse-sigma-ns", panel=_SYSTEM, help="Gaussian pulse: standard deviation, ns.", default="0.5"),
]
PulseFwhmNs = Annotated[
    float | None,
    _option("--pulse-fwhm-ns", panel=_SYSTEM, help="Gaussian pulse: full width at half maximum, ns."),
]
PulseFile = Annotated[
    Path | None,
    _option("--pulse-file", panel=_SYSTEM, help="Measured impulse response: 1-D .npy array."),
]
PulseBinNs = Annotated[
    float | None,
    _option("--pulse-bin-ns", panel=_SYSTEM, help="Sample width of --pulse-file, ns."),
]
PulseOrigin = Annotated[
    str | None,
    _option(
        "--pulse-origin", panel=_SYSTEM,
        help="What a delay refers to in --pulse-file: peak, centroid or first.", default="peak",
    ),
]
Start = Annotated[
    str | None,
    _option(
        "--start", panel=_SYSTEM,
        help="Pixel at the start of an exposure: armed (ready) or stationary (warmed up).", default="armed",
    ),
]
DetectionEfficiency = Annotated[
    float | None,
    _option(
        "--detection-efficiency", panel=_EFFECTS, default="1: --signal counts detectable photons",
        help="Photon detection efficiency, fill factor included, in (0, 1].",
    ),
]
DarkCountHz = Annotated[
    float | None,
    _option(
        "--dark-count-hz", "--dark-counts", panel=_EFFECTS, default="0",
        help="Dark counts of every pixel, counts/s, which no efficiency reduces.",
    ),
]
AfterpulseProbability = Annotated[
    float | None,
    _option(
        "--afterpulse-probability", panel=_EFFECTS,
        help="Mean number of trapped carriers that an avalanche leaves, those lost in the dead time included ...",
        default="0",
    ),
]
AfterpulseDelayNs = Annotated[
    float | None,
    _option("--afterpulse-delay-ns", panel=_EFFECTS, help="... and their mean delay after the avalanche, ns."),
]
TwilightNs = Annotated[
    float | None,
    _option(
        "--twilight-ns", panel=_EFFECTS, default="0",
        help="Arrivals this long before the end of the dead time fire at its end, ns.",
    ),
]
Crosstalk = Annotated[
    float | None,
    _option(
        "--crosstalk", panel=_EFFECTS, default="0",
        help="Mean number of neighbours that an avalanche triggers; with --engine sequential.",
    ),
]
CrosstalkKernel = Annotated[
    str | None,
    _option("--crosstalk-kernel", panel=_EFFECTS, help="Which neighbours: 4 or 8.", default="8"),
]
ElectronicsDeadTimeNs = Annotated[
    float | None,
    _option(
        "--electronics-dead-time-ns", panel=_EFFECTS, default="0",
        help="Dead time of the electronics after an event, ns; without effect unless longer than --dead-time-ns.",
    ),
]
MaxEventsPerPeriod = Annotated[
    int | None,
    _option("--max-events-per-period", panel=_EFFECTS, help="Events recorded of a period.", default="no limit"),
]
MaxEventsPerExposure = Annotated[
    int | None,
    _option("--max-events-per-exposure", panel=_EFFECTS, help="Events recorded of an exposure.", default="no limit"),
]
JitterFwhmNs = Annotated[
    float | None,
    _option("--jitter-fwhm-ns", panel=_EFFECTS, help="Gaussian timing jitter: full width at half maximum, ns."),
]
JitterTailNs = Annotated[
    float | None,
    _option("--jitter-tail-ns", panel=_EFFECTS, help="Mean of the exponential tail of the jitter, ns ..."),
]
JitterTailFraction = Annotated[
    float | None,
    _option("--jitter-tail-fraction", panel=_EFFECTS, help="... and share of the events that are in it."),
]
JitterFile = Annotated[
    Path | None,
    _option("--jitter-file", panel=_EFFECTS, help="Measured jitter instead: 1-D .npy array of its density."),
]
JitterBinNs = Annotated[
    float | None,
    _option("--jitter-bin-ns", panel=_EFFECTS, help="Sample width of --jitter-file, ns."),
]
CodeDensityFile = Annotated[
    Path | None,
    _option(
        "--code-density-file", panel=_EFFECTS,
        help="TDC non-linearity: 1-D .npy array of relative code widths; their number divides the bins.",
    ),
]
Signal = Annotated[
    float,
    _option(
        "--signal", panel=_LIGHT, default="1",
        help="Mean signal S over the pixels with a return, detectable photons per laser period.",
    ),
]
SignalLevel = Annotated[
    float | None,
    _option(
        "--signal", panel=_LIGHT, default="1",
        help="Mean signal S over the pixels with a return or light, detectable photons per laser period.",
    ),
]
Sbr = Annotated[
    float,
    _option("--sbr", panel=_LIGHT, help="Mean signal / mean ambient photons per period.", default="1"),
]
Attenuation = Annotated[
    str,
    _option(
        "--attenuation", panel=_LIGHT, default="none",
        help="Signal against depth z: none or inverse_square (1 / z^2).",
    ),
]
Ambient = Annotated[
    str | None,
    _option(
        "--ambient", panel=_LIGHT,
        help="Ambient light over the image: uniform, reflectivity, or map (of the scene).",
        default="map where there is one, else uniform",
    ),
]
Engine = Annotated[
    str,
    _option(
        "--engine", panel=_RUN, default="exact",
        help="exact; sequential (slow, independent gold standard); mars (count law x mean histogram); renewal, "
        "poisson (baselines).",
    ),
]
Table = Annotated[
    Path | None,
    _option(
        "--table", panel=_RUN,
        help="For --engine mars and renewal: a table of this system (mars-lidar table build).",
        default="every distinct pixel is evaluated by itself, which is slow",
    ),
]
Model = Annotated[
    Path | None,
    _option(
        "--model", panel=_RUN,
        help="For --engine neural: a network of this system (mars-lidar neural train).",
        default="the package's own, for the default system",
    ),
]
Count = Annotated[
    str | None,
    _option(
        "--count", panel=_RUN, default="exact",
        help="For --engine mars: the law of the count: exact, matched (to four cumulants, faster with --table) or "
        "gaussian (the paper's).",
    ),
]
Interpolation = Annotated[
    str | None,
    _option("--interpolation", panel=_RUN, default="bilinear", help="Of --table: bilinear or nearest."),
]
TableOutside = Annotated[
    str | None,
    _option(
        "--table-outside", panel=_RUN, default="error",
        help="Of --table, for pixels beyond its range: error, or exact (each is evaluated by itself, some ms).",
    ),
]
Realizations = Annotated[
    int,
    _option("--realizations", panel=_RUN, help="Independent exposures of the image.", default="1"),
]
Seed = Annotated[
    int,
    _option("--seed", panel=_RUN, help="Seed: the same command gives the same counts.", default="0"),
]
Threads = Annotated[
    int | None,
    _option("--threads", panel=_RUN, help="Threads; the counts do not depend on it.", default="all cores"),
]
Device = Annotated[
    str,
    _option("--device", panel=_RUN, help="cpu, or cuda: the current GPU, with the same counts.", default="cpu"),
]
Overwrite = Annotated[
    bool,
    _option("--overwrite", panel=_OUTPUT, help="Replace an existing cube and picture."),
]
Picture = Annotated[
    bool,
    _option("--picture/--no-picture", panel=_OUTPUT, help="A PNG overview beside the cube.", default="yes"),
]
