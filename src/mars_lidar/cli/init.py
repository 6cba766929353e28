"""`mars-lidar init`: a commented system file to start from."""

import json
from pathlib import Path

from mars_lidar._base import checks
from mars_lidar._base.files import write_text
from mars_lidar.cli.console import refuse_existing, table
from mars_lidar.cli.options import OutPath, Text, command
from mars_lidar.cli.system_options import DEFAULT_SYSTEM
from mars_lidar.instrument.effects import FIELDS
from mars_lidar.instrument.presets import INSTRUMENTS, PRESETS, sourced

_FILE = Path("system.yaml")


def commented(file: Path) -> str:
    """The text of the file, with the values of `DEFAULT_SYSTEM`."""
    effects = [f"#   {line}" for effect in FIELDS.values() for line in effect.example.splitlines()]
    text = Path(__file__).with_name("template.yaml").read_text(encoding="utf-8")
    return text.format(name=file, effects="\n".join(effects))


def of_instrument(name: str) -> str:
    """A system file of an instrument, each value with its source; a detector alone gets the default's laser."""
    checks.choice("preset", name, tuple(PRESETS))
    fields = sourced(name) if name in INSTRUMENTS else {"preset": (name, "fields as published: docs/detectors.md")}
    of_default = "not of the detector: the default of mars-lidar"
    default = {key: (getattr(DEFAULT_SYSTEM, key), of_default) for key in ("period_ns", "cycles", "bins")}
    laser = {**default, "pulse_fwhm_ns": (0.5, of_default), **INSTRUMENTS.get(name, {}).get("laser", {})}
    lines = [f"# {name}, for mars-lidar (docs/detectors.md). Check what is an assumption before you rely on it."]
    lines += [f"{key}: {value}  # {source}" for key, (value, source) in laser.items() if key != "pulse_fwhm_ns"]
    fwhm, source = laser["pulse_fwhm_ns"]
    lines += ["pulse:", "  kind: gaussian", f"  fwhm_ns: {fwhm}  # {source}", "detector:"]
    lines += [f"  {key}: {value}  # {source}" for key, (value, source) in fields.items() if key not in laser]
    return "\n".join([*lines, "start: armed", ""])


def schema(file: Text = "recipe", /, *, out: OutPath | None = None) -> None:
    """Write the JSON Schema of scene, recipe or system files, for editors.

    With it an editor completes and checks keys.

    Put this in the first line of the YAML file:  # yaml-language-server: $schema=recipe.json

    Arguments
    ---------
    file : {scene, recipe, system}
        Which file it describes: scene, recipe or system. [default: recipe]

    Options
    -------
    out
        A .json file, else standard output.
    """
    from mars_lidar.dataset.recipe import json_schema

    text = json.dumps(json_schema(file), indent=1, ensure_ascii=False) + "\n"
    if out is None:
        print(text, end="")
        return
    write_text(out, text)
    table([("wrote", str(out))])


def init(
    file: Path = _FILE, /, *, out: OutPath | None = None, preset: Text | None = None, overwrite: bool = False
) -> None:
    """Write a commented system file to start from.

    The YAML file describes laser, detector and histogram.

    Edit it and pass it on:  mars-lidar simulate --scene room --system system.yaml -o room.zarr

    Arguments
    ---------
    file
        Where to write it: .yaml or .yml. [default: system.yaml]

    Options
    -------
    out
        The same as FILE.
    preset
        An instrument: $presets.
    overwrite
        Replace an existing file.
    """
    if out is not None:
        if file != _FILE and file != out:
            raise ValueError(f"give the file once, got {str(file)!r} and --out {str(out)!r}")
        file = out
    checks.suffix("FILE", file, (".yaml", ".yml"))
    refuse_existing(file, overwrite)
    write_text(file, commented(file) if preset is None else of_instrument(preset))
    table([("wrote", str(file))])


init_command = command(init)
schema_command = command(schema)
