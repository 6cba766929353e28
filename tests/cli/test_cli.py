"""The command: what it writes, what it says, and its exit codes."""

import inspect
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
import xarray
from harness import make_system, refused

import mars_lidar as ml
from mars_lidar import _core, io
from mars_lidar.cli import _COMMANDS, main
from mars_lidar.cli import app as mars_lidar
from mars_lidar.cli.system_options import DEFAULT_SYSTEM
from mars_lidar.dataset import open_dataset
from mars_lidar.engines.feedback import Reason
from mars_lidar.io import recipe as recipes
from mars_lidar.io import zarr_store
from mars_lidar.io.store import Writer
from tests.harness.command import fails, listen_to_ctrl_c, ok, run, stopped

SMALL = ["--size", "12", "--cycles", "50", "--bins", "64"]


def command(*arguments: object) -> list[str]:
    code = "import sys; sys.argv[0] = 'mars-lidar'; from mars_lidar_command import main; sys.exit(main())"
    return [sys.executable, "-c", code, *(str(a) for a in arguments)]


def test_one_command_writes_a_cube_and_a_picture(tmp_path):
    done = ok("simulate", "--scene", "room", *SMALL, "--seed", 3, "-o", tmp_path / "room.zarr")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["room.png", "room.zarr"]
    assert (tmp_path / "room.png").read_bytes().startswith(b"\x89PNG")
    for word in ("registrations", "per registration", "room.zarr", "room.png"):
        assert word in done.output
    scene = ml.Scene.example("room", size=12)
    system = DEFAULT_SYSTEM.replace(cycles=50, bins=64)
    expected = ml.simulate(scene.flux(system, signal=1.0, sbr=1.0), system, seed=3)
    with xarray.open_zarr(tmp_path / "room.zarr") as data:
        assert np.array_equal(data.histogram, expected)
        assert np.array_equal(data.depth, scene.depth_m)
        assert np.array_equal(data.reflectivity, scene.reflectivity)
        assert json.loads(data.attrs["system"]) == system.to_dict()
        assert (data.attrs["engine"], data.attrs["seed"], data.attrs["complete"]) == ("exact", 3, True)


@pytest.mark.parametrize("engine", ["feedback", "auto"])
@pytest.mark.parametrize(
    ("light", "reason"),
    [
        (["--cycles", 50], "short exposure"),
        (["--cycles", 10_000, "--signal", 2, "--sbr", 0.01], "slow sweeps"),
        (["--cycles", 3000, "--signal", 40, "--sbr", 40], "locked in short exposure"),
        (["--cycles", 10_000, "--dead-time-ns", 1e-4], "too many cells"),
        (["--cycles", 30_000, "--signal", 2.3, "--sbr", 0.1], "unsettled"),
    ],
)
def test_pixels_given_to_the_exact_engine_are_said(tmp_path, engine, light, reason):
    """Each number of the report about them, and every reason, stands on the terminal."""
    out, small = tmp_path / "room.npz", ["--size", 4, "--bins", 64, "--seed", 3]
    done = ok("simulate", "--scene", "room", *small, *light, "--engine", engine, "-o", out, "--no-picture")
    printed = " ".join(done.output.split())
    cube, report = io.load(out), dict[str, float]()
    ml.simulate(cube.flux, cube.system, engine=engine, seed=3, report=report)
    about = {name: number for name, number in report.items() if "exact" in name}
    assert about
    if engine == "feedback":
        assert about[f"pixels given to exact, {reason}"] > 0
    for name, number in about.items():
        what, _, why = name.partition(", ")
        assert f"{what}{f' ({why})' if why else ''} {number:,.0f}" in printed


@pytest.mark.parametrize("reason", [Reason.UNLIKELY_COUNT, Reason.NEGATIVE_ARMED])
def test_exposures_that_a_check_refuses_are_said(tmp_path, monkeypatch, reason):
    """What hardly ever happens: the kernel's verdict on the first pixel is replaced."""
    drawn = _core.feedback_histogram

    def refused(job, pulse, out, pixels, status, *rest):
        drawn(job, pulse, out, pixels, status, *rest)
        status[0, 0] = reason

    monkeypatch.setattr(_core, "feedback_histogram", refused)
    out, light = tmp_path / "room.npz", ["--cycles", 10_000, "--signal", 0.5, "--sbr", 2]
    done = ok("simulate", "--scene", "room", "--size", 4, "--bins", 64, *light, "--engine", "feedback", "-o", out)
    words = " ".join(done.output.split())
    assert "pixels given to exact 1" in words
    assert f"pixels given to exact ({reason.name.lower().replace('_', ' ')}) 1" in words


@pytest.mark.parametrize("suffix", [".h5", ".npz", ".zarr"])
def test_every_option_of_the_run_reaches_the_file(tmp_path, suffix):
    np.save(tmp_path / "irf.npy", np.exp(-np.arange(50) / 9.0))
    out = tmp_path / f"cube{suffix}"
    options = (
        "--scene room --size 10 --scene-seed 4 --period-ns 80 --dead-time-ns 20 --cycles 40 --bins 32 "
        "--pulse-bin-ns 0.1 --pulse-origin centroid --start stationary --signal 0.7 --sbr 2.5 "
        "--attenuation inverse_square --ambient reflectivity --dark-count-hz 1e5 "
        "--engine sequential --realizations 3 --seed 8 --threads 1 --no-picture"
    )
    ok("simulate", *options.split(), "--pulse-file", tmp_path / "irf.npy", "-o", out)
    assert not out.with_suffix(".png").exists()
    pulse = ml.SampledPulse(np.exp(-np.arange(50) / 9.0), 0.1, "centroid")
    system = make_system(20.0, 40, 32, pulse=pulse, period_ns=80.0, start="stationary", dark_count_hz=1e5)
    flux = ml.Scene.example("room", size=10, seed=4).flux(
        system, signal=0.7, sbr=2.5, attenuation="inverse_square", ambient="reflectivity"
    )
    with io.load(out) as cube:
        assert cube.system == system
        assert (cube.engine, cube.seed, cube.shape) == ("sequential", 8, (3, 10, 10, 32))
        assert np.array_equal(cube.flux.background, flux.background)
        expected = ml.simulate(flux, system, engine="sequential", realizations=3, seed=8)
        assert np.array_equal(np.asarray(cube.histogram), expected)
        assert "seed 4" in cube.recipe.source


def test_warnings_are_one_line(tmp_path):
    depth = np.full((6, 8), 2.0)
    depth[0, 0] = np.nan
    np.save(tmp_path / "depth.npy", depth)
    out = tmp_path / "a.h5"
    done = ok("simulate", "--depth", tmp_path / "depth.npy", *SMALL[2:], "--no-picture", "-o", out)
    assert "mars-lidar: warning: 1 of 48 pixels have no return" in done.stderr
    assert "scene.py" not in done.stderr


def test_a_system_file_and_options_on_top_of_it(tmp_path):
    ok("init", tmp_path / "spad.yaml")
    assert ml.System.load(tmp_path / "spad.yaml") == DEFAULT_SYSTEM
    text = (tmp_path / "spad.yaml").read_text().replace("dead_time_ns: 75.0", "dead_time_ns: 33.0")
    (tmp_path / "spad.yaml").write_text(text)
    files = ["--system", tmp_path / "spad.yaml", "-o", tmp_path / "a.zarr"]
    ok("simulate", "--scene", "room", *SMALL, "--pulse-fwhm-ns", 2, "--no-picture", *files)
    with io.load(tmp_path / "a.zarr") as cube:
        assert cube.system.detector.dead_time_ns == 33.0
        assert cube.system.cycles == 50
        assert cube.system.pulse == ml.GaussianPulse.from_fwhm(fwhm_ns=2.0)


def test_init_does_not_overwrite(tmp_path):
    (tmp_path / "mine.yaml").write_text("mine")
    ok("init", "-o", tmp_path / "other.yaml")
    assert (tmp_path / "other.yaml").exists()
    assert run("init", tmp_path / "third.yaml", "-o", tmp_path / "other.yaml").exit_code == 2
    fails("exists already", "init", tmp_path / "mine.yaml")
    assert (tmp_path / "mine.yaml").read_text() == "mine"
    ok("init", tmp_path / "mine.yaml", "--overwrite")
    assert run("init", tmp_path / "mine.json").exit_code == 2


def test_info_tells_what_is_in_a_file(tmp_path):
    for name in ("a.zarr", "a.h5", "a.npz"):
        out = tmp_path / name
        ok("simulate", "--scene", "room", *SMALL, "--no-picture", "-o", out)
        done = ok("info", out)
        for words in (
            "complete       yes",
            "1 × 12 × 12 × 64",
            "engine         exact, seed 0",
            "GaussianPulse(sigma_ns=0.5)",
            "dead time 75 ns",
            f"mars_lidar.io.load('{out}')",
        ):
            assert words in done.output, words
        with io.load(out) as cube:
            assert f"registrations  {cube.registrations:,}" in done.output
        assert ("xarray.open_zarr" in done.output) == (out.suffix == ".zarr")
    verified = ok("info", "--verify", tmp_path / "a.h5")
    assert "every count is the same" in verified.output


def test_verify_fails_where_a_count_differs(tmp_path):
    import zarr

    out = tmp_path / "a.zarr"
    ok("simulate", "--scene", "room", *SMALL, "--no-picture", "-o", out)
    counts = zarr.open_group(tmp_path / "a.zarr")["histogram"]
    counts[0, 0, 0, 0] = 9999
    done = run("info", "--verify", tmp_path / "a.zarr")
    assert done.exit_code == 1
    assert "NO: histogram/c/0/0/0/0 has changed since it was written" in done.output
    assert "made by" not in done.output


def test_view_draws_a_cube(tmp_path):
    cube = tmp_path / "a.npz"
    ok("simulate", "--scene", "room", *SMALL, "--no-picture", "-o", cube)
    ok("view", cube, "-o", tmp_path / "v.png", "--pixel", "3,4", "--pixel", "0,11")
    assert (tmp_path / "v.png").read_bytes().startswith(b"\x89PNG")
    ok("view", cube, "-o", tmp_path / "v.pdf")
    assert (tmp_path / "v.pdf").read_bytes().startswith(b"%PDF")
    for wrong, words in (
        (("-o", tmp_path / "v.png"), "exists already"),
        (("-o", tmp_path / "w.gif"), "--out must end in one of .png, .pdf, .svg"),
        (("-o", tmp_path / "w.png", "--pixel", "3"), "--pixel must be two integers Y,X (row, column), got"),
        (("-o", tmp_path / "w.png", "--pixel", "12,0"), "y of pixels must be an integer in [0, 11], got 12"),
        (("-o", tmp_path / "w.png", "--realization", "1"), "realization must be"),
    ):
        done = fails(words, "view", cube, *wrong)
        assert len(done.stderr.splitlines()) == 1


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], "the scene is one of --scene, --depth and --transient, got none of them"),
        (["--scene", "room", "--depth", "d.png"], "got --scene and --depth"),
        (["--scene", "moon"], "--scene must be one of 'room', 'random', got 'moon'"),
        (["--scene", "room", "--image", "a.png"], "--image belongs to --depth"),
        (["--depth", "nowhere.png"], "nowhere.png"),
        (["--scene", "room", "--dead-time-ns", "-1"], "--dead-time-ns must be"),
        (["--scene", "room", "--sbr", "0"], "sbr must be a number in (0, inf]"),
        (["--scene", "room", "--system", "nowhere.yaml"], "nowhere.yaml"),
        (["--scene", "room", "--pulse-sigma-ns", "1", "--pulse-fwhm-ns", "1"], "give the pulse once"),
        (["--scene", "room", "--pulse-bin-ns", "1"], "belong to --pulse-file"),
        (["--scene", "room", "--pulse-file", "irf.npy"], "needs --pulse-bin-ns"),
        (["--scene", "room", "--pulse-file", "irf.csv", "--pulse-bin-ns", "1"], "irf.csv does not exist"),
        (["--scene", "room", "--seed", "-1"], "--seed must be an integer in [0, "),
        (["--scene", "room", "--out", "cube.csv"], "out must end in one of .zarr, .h5, .hdf5, .npz"),
        (["--scene", "room", "--out", "nowhere/cube.h5"], "out must lie in an existing folder"),
    ],
)
def test_bad_input_is_one_clear_line_and_exit_code_2(tmp_path, monkeypatch, arguments, words):
    monkeypatch.chdir(tmp_path)
    out = [] if "--out" in arguments else ["-o", "cube.zarr"]
    done = run("simulate", *SMALL[:2], *arguments, *out)
    assert done.exit_code == 2, done.output
    assert done.stderr.startswith("mars-lidar: ")
    assert words in done.stderr
    assert len(done.stderr.splitlines()) == 1
    assert list(tmp_path.iterdir()) == []


def test_usage_errors_are_exit_code_2():
    assert run("simulate", "--scene", "room").exit_code == 2
    assert run("simulate", "--bins", "many", "-o", "a.zarr").exit_code == 2
    assert run("fly").exit_code == 2


def test_existing_output_is_refused(tmp_path):
    out = tmp_path / "a.zarr"
    ok("simulate", "--scene", "room", *SMALL, "-o", out)
    fails("a.png exists already; give --overwrite", "simulate", "--scene", "room", *SMALL, "--seed", 1, "-o", out)
    done = run("simulate", "--scene", "room", *SMALL, "--seed", 1, "-o", out, "--no-picture")
    assert done.exit_code == 2
    assert "a.zarr exists already; give --overwrite" in done.stderr
    ok("simulate", "--scene", "room", *SMALL, "--seed", 1, "-o", out, "--overwrite")
    with io.load(out) as cube:
        assert cube.seed == 1


def test_files_that_cannot_be_read_are_named(tmp_path):
    (tmp_path / "junk.h5").write_bytes(b"junk")
    wrong = {"none.zarr": "does not exist", "junk.h5": "cannot be read as a cube", "a.doc": "must end in"}
    for name, words in wrong.items():
        done = fails(words, "info", tmp_path / name)
        assert len(done.stderr.splitlines()) == 1


def test_a_full_disk_is_exit_code_1(tmp_path, monkeypatch):
    from mars_lidar.io.store import Writer

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Writer, "write", full)
    done = run("simulate", "--scene", "room", *SMALL, "-o", tmp_path / "a.zarr")
    assert done.exit_code == 1
    remaining = f"{tmp_path / 'a.zarr'} stays, marked incomplete: --resume (resume=True) continues it"
    assert done.stderr == f"mars-lidar: failed: No space left on device; {remaining}\n"
    assert "complete       NO: the simulation did not finish" in run("info", tmp_path / "a.zarr").output
    fails("is incomplete", "view", tmp_path / "a.zarr", "-o", tmp_path / "a.png")


def test_info_says_when_only_a_leftover_is_there(tmp_path):
    (tmp_path / "a.h5.incomplete").write_bytes(b"")
    for name in ("a.h5", "a.h5.incomplete"):
        done = ok("info", tmp_path / name)
        assert "complete       NO: " in done.output


@pytest.mark.skipif(os.name != "posix", reason="needs POSIX signals")
@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGKILL])
def test_a_stopped_run_is_left_incomplete(tmp_path, how):
    out = tmp_path / "a.zarr"
    long = ["--scene", "room", "--size", 128, "--cycles", 1_000_000, "--bins", 64]  # minutes
    process = subprocess.Popen(
        command("simulate", *long, "-o", out), stderr=subprocess.PIPE, text=True, preexec_fn=listen_to_ctrl_c
    )
    _wait_for(out / "histogram" / "zarr.json")
    time.sleep(0.3)
    words, seconds = stopped(process, how)
    if how == signal.SIGINT:
        assert seconds < 2.0  # of two threads: promised within a second
        assert process.returncode == 130
        assert f"mars-lidar: interrupted; {out} stays, marked incomplete: --resume" in words
    else:
        assert process.returncode == -signal.SIGKILL
    assert not (tmp_path / "a.png").exists()
    done = ok("info", out)
    assert "complete       NO: the simulation did not finish; at least 0 of 1 chunks" in done.output


@pytest.mark.skipif(os.name != "posix", reason="needs POSIX signals")
@pytest.mark.parametrize("module", ["mars_lidar", "numpy", "mars_lidar.calibration", "cyclopts"])
def test_ctrl_c_while_python_imports_is_one_line(module):
    code = f"""
import os, signal, sys
class Press:
    def find_spec(name, path=None, target=None):
        if name == {module!r}:
            os.kill(os.getpid(), signal.SIGINT)
sys.meta_path.insert(0, Press)
from mars_lidar_command import main
sys.exit(main())
"""
    arguments = ["calibrate", "--help"]
    done = subprocess.run(
        [sys.executable, "-c", code, *arguments], capture_output=True, text=True, preexec_fn=listen_to_ctrl_c
    )
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "mars-lidar: interrupted\n")


def test_what_python_makes_of_exhausted_memory_is_one_line(monkeypatch, capsys):
    """Seen with 800 MB of addresses while Matplotlib was imported; another SystemError keeps its traceback."""
    for text in ("<built-in function __build_class__> returned NULL without setting an exception", "another"):

        def exhausted(*_: object, text=text) -> None:
            raise SystemError(text)

        monkeypatch.setattr("mars_lidar.cli.console._refuse_empty", exhausted)
        if text == "another":
            refused(text, main, ["info"], error=SystemError)
        else:
            assert main(["info"]) == 1
            assert capsys.readouterr().err.startswith("mars-lidar: failed: the memory")


def _wait_for(path: Path) -> None:
    end = time.monotonic() + 300.0
    while not path.exists():
        assert time.monotonic() < end, f"{path} did not appear"
        time.sleep(0.05)


def test_help_teaches_and_starts_light():
    text = run("simulate", "--help").output
    for words in ("--dead-time-ns", "default: 75", "Examples", "simulate --scene room -o room.zarr"):
        assert words in text
    assert run("--version").output == f"mars-lidar {ml.__version__}\n"
    heavy = {"matplotlib", "zarr", "h5py", "xarray", "scipy", "PIL", "yaml", "torch", "mars_lidar.engines"}
    for arguments in ([], ["--help"], ["--version"]):
        code = f"import sys; from mars_lidar.cli import main; main({arguments}); print(*({heavy!r} & set(sys.modules)))"
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
        assert done.stdout.splitlines()[-1] == ""


def test_the_list_of_commands_has_the_summaries_of_their_docstrings():
    for name, (_, summary) in (entry for entries in _COMMANDS.values() for entry in entries.items()):
        docstring = inspect.getdoc(mars_lidar[name].default_command) if name != "table" else summary
        assert " ".join(docstring.split("\n\n")[0].split()) == summary


def install_completion(home: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    env = {name: value for name, value in os.environ.items() if name not in ("ZSH", "ZSH_CUSTOM")} | {"HOME": str(home)}
    return subprocess.run(command("--install-completion", *arguments), env=env, capture_output=True, text=True)


@pytest.mark.skipif(shutil.which("bash") is None or sys.platform == "win32", reason="needs bash")
def test_bash_completes_commands_and_options_once_installed(tmp_path):
    (tmp_path / ".bashrc").write_text("export OWN=1\n")
    done = install_completion(tmp_path, "--shell", "bash")
    assert done.returncode == 0, done.stderr
    script = tmp_path / ".local/share/bash-completion/completions/mars-lidar"
    changed = {path for path in tmp_path.rglob("*") if path.is_file()}
    assert changed == {script, tmp_path / ".bashrc"}
    assert all(str(path) in done.stdout for path in changed)
    for words, expected in {
        "mars-lidar recon": "reconstruct",
        "mars-lidar table ": "build clear info",
        "mars-lidar reconstruct --meth": "--method",
        "mars-lidar simulate --detec": "--detection-efficiency --detector",
    }.items():
        ask = f"""
            source ~/.bashrc; [[ $OWN == 1 ]]
            COMP_LINE='{words}' COMP_POINT={len(words)} COMP_WORDS=({words!s} {"''" if words.endswith(" ") else ""})
            COMP_CWORD=$((${{#COMP_WORDS[@]}} - 1))
            $(complete -p mars-lidar | sed 's/.*-F \\([^ ]*\\) .*/\\1/')
            printf '%s\\n' "${{COMPREPLY[@]}}" | sort | xargs"""
        replies = subprocess.run(
            ["bash", "--norc", "-c", ask], env=os.environ | {"HOME": str(tmp_path)}, capture_output=True, text=True
        )
        assert replies.stdout.strip() == expected, (words, replies.stderr)


def test_a_completion_that_is_refused_changes_nothing(tmp_path):
    done = install_completion(tmp_path, "--shell", "tcsh")
    assert done.returncode == 2
    assert "--shell must be one of 'zsh', 'bash', 'fish', 'powershell', got 'tcsh'" in done.stderr
    assert list(tmp_path.iterdir()) == []


def test_nothing_is_written_into_a_store(tmp_path):
    store = tmp_path / "a.zarr"
    ok("simulate", "--scene", "room", *SMALL, "--no-picture", "-o", store)
    before = sorted(store.rglob("*"))
    for inside in (store / "b.zarr", store / "depth" / "b.h5"):
        fails(f"inside of another store, {store}", "simulate", "--scene", "room", *SMALL, "--no-picture", "-o", inside)
    assert sorted(store.rglob("*")) == before


def test_help_flows(monkeypatch):
    """A paragraph of a command's help has no line end where its docstring has one."""
    monkeypatch.setenv("COLUMNS", "400")
    assert "interruptions: the same recipe gives the same files" in run("generate", "--help").output
    assert "opens a .zarr with named dimensions and units" in run("simulate", "--help").output


def test_examples_of_the_help_can_be_copied_from_a_narrow_screen(monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    for name in ("simulate", "generate", "calibrate", "reconstruct", "explore", "convert", "export", "timestamps"):
        examples = run(name, "--help").output.split("Examples:\n")[1].split("\n\n")[0]
        commands = examples.replace("\\\n", " ").splitlines()
        assert all(line.startswith("  mars-lidar ") for line in commands), examples


@pytest.mark.parametrize("arguments", [("--help",), ("simulate", "--help"), ("schema",)], ids=" ".join)
def test_a_reader_that_stops_ends_it_without_a_traceback(arguments):
    reading, writing = os.pipe()
    os.close(reading)
    with open(writing, "wb") as pipe:
        done = subprocess.run(command(*arguments), stdout=pipe, stderr=subprocess.PIPE, text=True)
    assert (done.returncode, done.stderr) == (1, "")


def test_a_pipe_without_unicode_gets_plain_text(tmp_path):
    out = tmp_path / "a.zarr"
    ok("simulate", "--scene", "room", *SMALL, "--no-picture", "-o", out)
    done = subprocess.run(
        command("info", out), env=os.environ | {"PYTHONIOENCODING": "ascii"}, capture_output=True, check=True
    )
    assert b"1 ? " in done.stdout
    assert done.stderr == b""


def within(mebibytes: int, *words: object) -> int:
    """Exit code of a command in a small address space: it ends well, or with one line and nothing else."""
    import resource

    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_AS, (mebibytes << 20, mebibytes << 20))

    done = subprocess.run(command(*words), capture_output=True, text=True, preexec_fn=limit, timeout=300)
    assert done.returncode in (0, 1, 2), done
    assert "Traceback" not in done.stderr
    assert done.returncode == 0 or done.stderr.startswith("mars-lidar: "), done.stderr
    return done.returncode


@pytest.mark.full
@pytest.mark.skipif(sys.platform != "linux", reason="needs a limit on the address space")
@pytest.mark.parametrize("mebibytes", [300, 700])
@pytest.mark.parametrize("words", ["generate room --scene-seeds 3", "simulate --scene room --no-picture"])
def test_a_small_address_space_is_one_line(words, mebibytes, tmp_path):
    """Threads that cannot start, here or in Zarr, are neither a traceback nor waited for without end."""
    code = within(mebibytes, *words.split(), "--size", 32, "-o", tmp_path / "a.zarr")
    assert mebibytes > 300 or code != 0


@pytest.mark.full
@pytest.mark.skipif(sys.platform != "linux", reason="needs a limit on the address space")
@pytest.mark.parametrize(
    "line",
    [
        "verify {0}/set.zarr",
        "export {0}/set.zarr --layout lindell -o {0}/out",
        "info {0}/a.zarr",
        "convert {0}/a.zarr {0}/out.h5",
    ],
)
def test_reading_a_store_in_a_small_address_space_is_one_line(line, tmp_path):
    """SciPy's matrix library, loaded behind the threads of Zarr, never returned, or sent the process a Ctrl-C."""
    ok("generate", "room", "--size", 16, "--bins", 64, "--cycles", 20, "-o", tmp_path / "set.zarr")
    ok("simulate", "--scene", "room", *SMALL, "--no-picture", "-o", tmp_path / "a.zarr")
    for mebibytes in (450, 650):
        code = within(mebibytes, *line.format(tmp_path).split())
        written = list(tmp_path.glob("out*"))
        assert code == 0 or not written, "nothing half written"
        for path in written:
            shutil.rmtree(path) if path.is_dir() else path.unlink()


# What goes on: an interrupted simulate, a sample of a dataset as a picture, a PTU with a clock of one's own.


SYSTEM = make_system(50.0, 40, 64, sigma_ns=0.5)


@pytest.fixture
def in_small_blocks(monkeypatch):
    """Chunks of one row, blocks of two."""
    monkeypatch.setattr(zarr_store, "_CHUNK_BYTES", 2 * 64 * 12)
    monkeypatch.setattr(recipes, "BLOCK_BYTES", 2 * 2 * 64 * 12)


def flux_of(size: int = 12, **light: float) -> ml.Flux:
    return ml.Scene.example("room", size=size).flux(SYSTEM, **{"signal": 1.0, "sbr": 1.0, **light})


@pytest.mark.parametrize("stop_after", [0, 1, 4, 11])
def test_an_interrupted_cube_goes_on_to_the_same_bits(tmp_path, monkeypatch, in_small_blocks, stop_after):
    flux, made = flux_of(), []
    write = Writer.write

    def stopping(self, images, rows, block):
        if len(made) == stop_after:
            raise KeyboardInterrupt
        made.append((images, rows))
        write(self, images, rows, block)

    monkeypatch.setattr(Writer, "write", stopping)
    with pytest.raises(io.Interrupted, match=r"--resume \(resume=True\) continues it"):
        io.simulate_to(tmp_path / "a.zarr", flux, SYSTEM, realizations=2, seed=5)
    if stop_after > 1:  # what was written last may be cut short: it is made again
        some = next((tmp_path / "a.zarr" / "histogram" / "c" / str(made[-1][0].start)).rglob("0"))
        some.write_bytes(b"half") if some.is_file() else None
    made.clear()
    monkeypatch.setattr(Writer, "write", lambda *a: (made.append(a[1:3]), write(*a))[1])
    done = io.simulate_to(tmp_path / "a.zarr", flux, SYSTEM, realizations=2, seed=5, resume=True)
    assert len(made) == 12 - max(0, stop_after - 1)
    expected = ml.simulate(flux, SYSTEM, realizations=2, seed=5)
    with io.load(tmp_path / "a.zarr") as cube:
        assert cube.complete
        assert np.array_equal(cube.histogram[:], expected)
        assert cube.registrations == done.registrations == expected.sum()
    again = io.simulate_to(tmp_path / "a.zarr", flux, SYSTEM, realizations=2, seed=5, resume=True)
    assert (again.registrations, again.simulate_s) == (expected.sum(), 0.0)  # nothing is left to do


def test_a_cube_of_something_else_is_not_gone_on_with(tmp_path):
    io.simulate_to(tmp_path / "a.zarr", flux_of(), SYSTEM)
    for change, message in (
        ({"seed": 1}, "begun with another seed"),
        ({"system": SYSTEM.replace(cycles=41)}, "begun with another"),
        ({"flux": flux_of(signal=2.0)}, "begun with another"),
    ):
        given = {"flux": flux_of(), "system": SYSTEM, **change}
        refused(message, io.simulate_to, tmp_path / "a.zarr", **given, resume=True)
    io.simulate_to(tmp_path / "a.h5", flux_of(), SYSTEM)
    refused(r"resume is for a \.zarr", io.simulate_to, tmp_path / "a.h5", flux_of(), SYSTEM, resume=True)
    refused("exclude each other", io.simulate_to, tmp_path / "a.zarr", flux_of(), SYSTEM, resume=True, overwrite=True)


@pytest.mark.full
def test_the_command_resumes(tmp_path):
    given = ["simulate", "--scene", "room", "--size", 12, "--cycles", 40, "--bins", 64, "-o", tmp_path / "a.zarr"]
    ok(*given, "--resume")
    import zarr

    zarr.open_group(tmp_path / "a.zarr", mode="r+").update_attributes({"complete": False})
    ok(*given, "--resume")
    with io.load(tmp_path / "a.zarr") as cube:
        assert cube.complete
        assert io.verify(cube)
    assert run(*given).exit_code == 2


@pytest.mark.full
def test_a_sample_of_a_dataset_is_a_cube_with_its_picture(tmp_path):
    recipe = {
        "scenes": {"example": "room", "size": 16, "seeds": [0, 1]},
        "systems": SYSTEM,
        "light": {"signal": [0.5, 2.0], "sbr": 1.0},
        "realizations": 2,
    }
    ml.generate(recipe, tmp_path / "set.zarr")
    cube = open_dataset(tmp_path / "set.zarr").cube(3)
    assert cube.recipe.source == "room, size 16, seed 1"
    assert np.array_equal(cube.histogram, ml.simulate(cube.flux, SYSTEM, realizations=2, seed=cube.seed))
    ok("view", tmp_path / "set.zarr", "--sample", 3, "--realization", 1, "-o", tmp_path / "a.png")
    assert (tmp_path / "a.png").read_bytes().startswith(b"\x89PNG")
    done = run("view", tmp_path / "set.zarr", "--sample", 4, "-o", tmp_path / "b.png")
    assert (done.exit_code, "--sample must be an integer in [0, 3], got 4" in done.stderr) == (2, True)
    io.save(tmp_path / "c.npz", cube)
    assert "--sample is for datasets" in run("view", tmp_path / "c.npz", "--sample", 0, "-o", tmp_path / "b.png").stderr


@pytest.mark.parametrize(("clock_ps", "codes"), [(None, 32768), (400.0, 64 * 3), (1e3, 64), (1e9, 64)])
def test_the_clock_of_a_ptu_is_as_fine_as_asked(tmp_path, clock_ps, codes):
    ptufile = pytest.importorskip("ptufile")
    times = ml.simulate_timestamps(flux_of(), SYSTEM)
    times.save(tmp_path / "a.ptu", clock_ps=clock_ps)
    again = ml.Timestamps.load(tmp_path / "a.ptu")
    assert np.array_equal(again.histogram(), times.histogram())
    assert np.abs(again.times_ns - times.times_ns).max() <= 0.5 * 100.0 / codes + 1e-9
    with ptufile.PtuFile(tmp_path / "a.ptu") as file:
        assert file.number_bins_in_period == codes
        image = file.decode_image(channel=0).sum(axis=0)
    assert image.sum() == times.histogram().sum()
    refused(r"clock_ps belongs to a \.ptu", times.save, tmp_path / "a.npz", clock_ps=100.0)


def test_the_command_tells_of_large_images(tmp_path, monkeypatch):
    pytest.importorskip("ptufile")
    monkeypatch.setattr(import_module("mars_lidar.cli.convert"), "_LARGE_IMAGE", 1e6)
    io.simulate_to(tmp_path / "a.zarr", flux_of(), SYSTEM)
    assert "--clock-ps a smaller one" in ok("timestamps", tmp_path / "a.zarr", "-o", tmp_path / "a.ptu").stdout
    done = run("timestamps", tmp_path / "a.zarr", "--clock-ps", 1500, "-o", tmp_path / "b.ptu")
    assert (done.exit_code, "in units of 1562 ps" in done.stdout) == (0, True), done.output
    done = run("convert", tmp_path / "a.ptu", tmp_path / "c.ptu", "--clock-ps", 1500)
    assert (done.exit_code, (tmp_path / "c.ptu").exists()) == (0, True), done.output


# Without any of the optional libraries: one line that names the extra, never a traceback.


HIDDEN = Path(__file__).parents[1] / "hidden_library.py"
# library, extra, and whether public names and commands are to miss it; each by itself by night
LIBRARIES = [
    ("torch", "learn", True, False),
    ("skimage", "estimate", False, True),
    ("ptufile", "io", False, True),
    ("phconvert", "io", False, True),
    ("OpenEXR", "io", False, False),
    ("distributed", "cluster", False, True),
    ("cupy", "cuda", False, True),
    ("torch,skimage,ptufile,phconvert,OpenEXR,xarray,distributed,cupy", "learn,estimate,io,cluster,cuda", True, True),
]


@pytest.mark.full
@pytest.mark.parametrize(
    ("library", "extra", "names", "commands"),
    [LIBRARIES[0], LIBRARIES[-1], *(pytest.param(*each, marks=pytest.mark.nightly) for each in LIBRARIES[1:-1])],
)
def test_what_misses_a_library_names_its_extra(tmp_path, library, extra, names, commands):
    done = subprocess.run(
        [sys.executable, HIDDEN, library, extra, tmp_path], capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stdout + done.stderr
    words = re.search(r"(\d+) names and (\d+) commands", done.stdout)
    assert words, done.stdout
    assert (int(words[1]) > 0, int(words[2]) > 0) == (names, commands), done.stdout


def test_an_exr_names_its_extra(tmp_path):
    (tmp_path / "depth.exr").write_bytes(b"")
    code = (
        "import sys; sys.modules['OpenEXR'] = None\nimport mars_lidar as ml\n"
        f"ml.Scene.from_rgbd({str(tmp_path / 'depth.exr')!r})"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert "pip install 'mars-lidar[io]'" in done.stderr.splitlines()[-1]


def test_a_labelled_cube_names_its_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "xarray", None)
    system = make_system(50.0, 10, 8)
    with pytest.raises(ml.io.MissingLibraryError, match=r"mars-lidar\[io\]"):
        ml.to_xarray(np.zeros((1, 1, 1, 8), np.uint16), system)
