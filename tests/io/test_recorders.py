"""Files of photon counters, written here byte by byte as their makers document them, and read through the libraries."""

import struct
from pathlib import Path

import numpy as np
import pytest
from harness import make_system, refused

import mars_lidar as ml
from mars_lidar import io
from mars_lidar.io.streams import formats
from mars_lidar.io.streams.recorders import recorded
from tests.harness.command import ok

pytest.importorskip("ptufile", reason="ptufile (extra io) is not installed")
PERIOD_NS, CYCLES = 50.0, 5000
SYSTEM = make_system(80.0, CYCLES, 1000, sigma_ns=0.5, period_ns=PERIOD_NS, start="armed")


def simulated() -> ml.Timestamps:
    return ml.simulate_timestamps(ml.Flux([[0.1, 0.0, 0.3]], 0.02, 20.0), SYSTEM, seed=3)


def parts(fine_ns: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Periods, units of `fine_ns` and channels of all photons in order of time."""
    times = simulated()
    channel = np.repeat(np.arange(3), times.counts.ravel())
    fine = ((times.times_ns - times.cycle * PERIOD_NS) / fine_ns).astype(np.int64)
    order = np.argsort(times.times_ns, kind="stable")
    return times.cycle[order].astype(np.int64), fine[order], channel[order]


def text(ident: bytes, version: bytes) -> bytes:
    return struct.pack("<16s6s18s12s18s2s256s", ident, version, b"test", b"1", b"01/01/26 00:00:00", b"\r\n", b"")


def pico_header(mode: int, number: int, image: tuple[int, ...] = (), rate: int = 20_000_000) -> bytes:
    """PicoHarp 300, file format 2.0."""
    body = struct.pack("<18i", 1, 32, 4, 1, 0, mode, 3 if image else 0, 0, 0, 1000, *([0] * 8))
    body += bytes(8 * 8 + 3 * 12 + 36)
    body += struct.pack("<16s8siiiiiifii", b"PicoHarp 300", b"1", 1, 1, 10, 100, 10, 100, 0.016, 0, 0)
    body += bytes(4 * 24) + struct.pack("<9i", 1, 0, 0, rate, 100, 0, 0, number, len(image))
    return text(b"PicoHarp 300", b"2.0") + body + struct.pack(f"<{len(image)}i", *image)


def hydra_header(version: bytes, mode: int, number: int, inputs: int = 4) -> bytes:
    """HydraHarp 400, file formats 1.0 and 2.0."""
    body = struct.pack("<6id10i", 1, 32, 0, mode, 0, 0, 16.0, 0, 1000, *([0] * 8))
    body += bytes(8 * 8 + 3 * 12 + 36)
    body += struct.pack("<16s8sii", b"HydraHarp 400", b"1", 1, 1) + bytes(80)
    body += struct.pack("<dQ8i", 1.0, 15, inputs, 0, 1, 0, 1, 100, 10, 0) + bytes(20 * inputs)
    body += struct.pack("<iiiiQ", 20_000_000, 0, 0, 0, number)
    return text(b"HydraHarp 400", version) + body


def with_wraps(clock: np.ndarray, words: np.ndarray, wrap: int, overflow: int) -> np.ndarray:
    """Records with a record of overflow for each time that the clock's `wrap` is passed."""
    turns = np.diff(clock // wrap, prepend=0)
    return np.insert(words, np.repeat(np.arange(clock.size), turns), overflow)


def pt3(path: Path) -> Path:
    cycle, fine, channel = parts(0.016)
    words = ((channel + 1) << 28) | (fine << 16) | (cycle % 65536)  # channels 1 to 4, 15 is special
    records = with_wraps(cycle, words, 65536, 0xF << 28)
    path.write_bytes(pico_header(3, records.size) + records.astype("<u4").tobytes())
    return path


def ht3(path: Path, version: bytes = b"2.0") -> Path:
    cycle, fine, channel = parts(0.016)
    words = (channel << 25) | (fine << 10) | (cycle % 1024)
    records = with_wraps(cycle, words, 1024, (1 << 31) | (63 << 25) | (version == b"2.0"))
    path.write_bytes(hydra_header(version, 3, records.size) + records.astype("<u4").tobytes())
    return path


def check_photons(times: ml.Timestamps, first: int, fine_ns: float) -> None:
    """Every photon came back, in its channel, period and unit."""
    cycle, fine, channel = parts(fine_ns)
    assert times.period_ns == pytest.approx(PERIOD_NS, rel=1e-12)
    for k in range(3):
        if not (channel == k).any():
            continue
        of_pixel = times.pixel(0, k + first)
        assert np.array_equal(of_pixel.cycle, cycle[channel == k])
        assert np.allclose(of_pixel.times_ns % PERIOD_NS, (fine[channel == k] + 0.5) * fine_ns, atol=1e-6)


def test_pt3(tmp_path):
    check_photons(ml.Timestamps.load(pt3(tmp_path / "a.pt3")), 0, 0.016)  # ptufile counts channels from 0
    reader = pytest.importorskip("phconvert.pqreader", reason="phconvert (extra io) is not installed")
    pytest.importorskip("numba", reason="phconvert without numba wants two overflows")
    cycle, detector, fine, _, _ = reader.load_pt3(str(tmp_path / "a.pt3"))  # another reader finds the same
    selected = detector != 15
    assert np.array_equal(cycle[selected], parts(0.016)[0])
    assert np.array_equal(fine[selected], parts(0.016)[1])


@pytest.mark.parametrize("version", [b"1.0", b"2.0"])
def test_ht3(tmp_path, version):
    check_photons(ml.Timestamps.load(ht3(tmp_path / "a.ht3", version)), 0, 0.016)


@pytest.mark.parametrize(("suffix", "unit_ns"), [(".pt2", 0.004), ("1.ht2", 0.0005), ("2.ht2", 0.001)])
def test_absolute_times(tmp_path, suffix, unit_ns):
    """T2: a channel that comes as evenly as laser pulses is the sync; without it, no period is made up."""
    cycle, fine, channel = parts(0.016)
    photons = np.round((cycle * PERIOD_NS + fine * 0.016) / unit_ns).astype(np.int64)
    sync = np.round(np.arange(CYCLES) * PERIOD_NS / unit_ns).astype(np.int64)
    clock = np.concatenate([sync, photons])
    number = np.concatenate([np.zeros(sync.size, np.int64), channel + 1])
    order = np.argsort(clock, kind="stable")
    clock, number = clock[order], number[order]
    path = tmp_path / f"a{suffix}"
    if suffix == ".pt2":
        wrap = 210_698_240
        records = with_wraps(clock, (number << 28) | (clock % wrap), wrap, 0xF << 28)
        path.write_bytes(pico_header(2, records.size) + records.astype("<u4").tobytes())
    else:
        version = f"{suffix[0]}.0".encode()
        wrap = 33_552_000 if version == b"1.0" else 33_554_432
        special = np.where(number == 0, 1 << 31, 0)  # the sync is a special record of channel 0
        words = special | (np.maximum(number - 1, 0) << 25) | (clock % wrap)
        records = with_wraps(clock, words, wrap, (1 << 31) | (63 << 25) | (version == b"2.0"))
        path.write_bytes(hydra_header(version, 2, records.size) + records.astype("<u4").tobytes())
    times = ml.Timestamps.load(path, bins=1000)
    assert times.period_ns == pytest.approx(PERIOD_NS, rel=1e-7)
    for k in (0, 2):
        of_pixel = times.pixel(0, k + (suffix == ".pt2"))
        assert np.array_equal(of_pixel.cycle, cycle[channel == k])
        assert np.allclose(
            of_pixel.times_ns - of_pixel.cycle * times.period_ns, fine[channel == k] * 0.016, atol=2 * unit_ns
        )
    bare = formats.recorded(path)
    assert bare.fine is None
    assert bare.clock_ns == pytest.approx(unit_ns)
    assert np.array_equal(np.sort(bare.clock), np.sort(clock))


@pytest.mark.parametrize("version", [b"5.0", b"6.0"])
def test_t3r_has_histograms_but_no_periods(tmp_path, version):
    """TimeHarp 200: its clock of 100 ns is not the laser's."""
    cycle, fine, channel = parts(0.04)
    clock = (cycle * PERIOD_NS / 100.0).astype(np.int64)
    words = (1 << 30) | (channel << 28) | (fine << 16) | (clock % 65536)
    records = with_wraps(clock, words, 65536, 0x800 << 16)
    records = np.insert(records, 5, 1 << 16)  # a marker, no overflow
    if version == b"5.0":
        header = struct.pack("<16s6s6s18s2s256s", b"TimeHarp 200", version, b"1.0", b"01/01/26", b"\r\n", b"")
        names = b""
    else:
        header, names = text(b"TimeHarp 200", version), struct.pack("<16s8s", b"TimeHarp 200", b"2.0")
    header += struct.pack("<19i", 4096, 1, 32, 4, 1, *([0] * 14)) + bytes(64 + 36 + 36)
    header += names + struct.pack("<5if", 1, 0, 0, 0, 0, 0.04)
    tags = [100, 0, 0, 0, 0, 0, 0, 20_000_000, 0, 0, 0, records.size, 3]
    path = tmp_path / "a.t3r"
    path.write_bytes(header + struct.pack("<13i", *tags) + bytes(12) + records.astype("<u4").tobytes())
    result = formats.recorded(path)
    assert (result.clock_ns, result.period_ns) == (pytest.approx(100.0), None)
    assert np.array_equal(result.clock, clock)
    assert np.array_equal(result.detector, channel)
    histograms = recorded(path).arrays
    for k in (0, 2):
        counts = np.bincount(fine[channel == k], minlength=fine.max() + 1)
        assert np.array_equal(histograms[f"channel {k}"], counts)
    refused("runs free", ml.Timestamps.load, path)
    refused("must count laser periods of 50 ns", ml.Timestamps.load, path, period_ns=50.0)
    content = path.read_bytes()
    for damaged, reason in (
        (content[:-400], "cut short"),
        (content[:300], "cut short"),
        (content.replace(version, b"7.0", 1), "no .t3r of format 5.0 or 6.0"),
        (header + struct.pack("<13i", *(-1, *tags[1:])) + content[-4 * records.size :], "its clocks are -1 ns"),
        (header + struct.pack("<13i", *tags[:12], -2) + content[-4 * records.size :], "image header -2"),
        (header + struct.pack("<13i", *tags[:11], -5, 3) + content[-4 * records.size :], "states -5 records"),
    ):
        path.write_bytes(damaged)
        refused(f"a\\.t3r.*{reason}", formats.recorded, path)


def becker(path: Path, clock_is_sync: int, marker: bool = False) -> Path:
    """An SPC-150's .spc and .set: reversed 12-bit ADC, macro time of 12 bits."""
    cycle, fine, channel = parts(PERIOD_NS / 4096)
    words = ((4095 - fine) << 16) | (channel << 12) | (cycle % 4096)
    turns = np.diff(cycle // 4096, prepend=0)
    words = words | np.where(turns == 1, 1 << 30, 0)
    assert turns.max() <= 1
    if marker:
        words = np.append(words, 0xD << 28)
    path.write_bytes(struct.pack("<I", (1 << 31) | 500) + words.astype("<u4").tobytes())
    setup = f"*SETUP\r\n  SYS_PARA_BEGIN:\r\n  #SP [SP_TAC_R,F,{PERIOD_NS * 1e-9}]\r\n  #SP [SP_TAC_G,I,1]\r\n"
    setup += f"  #SP [SP_MST_CLK,I,{clock_is_sync}]\r\n  SYS_PARA_END:\r\n*END\r\n"
    info = "*IDENTIFICATION\r\n  ID        : SPC Setup Script File\r\n  Title     : test\r\n*END\r\n"
    header = struct.pack("<hihihihIihhHIHH", (0x28 << 4) | 15, 42, len(info), 42 + len(info), len(setup), *([0] * 10))
    path.with_suffix(".set").write_bytes(header + (info + setup).encode())
    return path


def test_spc(tmp_path):
    pytest.importorskip("phconvert", reason="phconvert (extra io) is not installed")
    check_photons(ml.Timestamps.load(becker(tmp_path / "a.spc", 1)), 0, PERIOD_NS / 4096)
    refused("runs free", ml.Timestamps.load, becker(tmp_path / "b.spc", 0))
    check_photons(ml.Timestamps.load(tmp_path / "b.spc", period_ns=50.0), 0, PERIOD_NS / 4096)
    refused("markers of a scan", ml.Timestamps.load, becker(tmp_path / "c.spc", 1, marker=True))
    (tmp_path / "a.set").unlink()
    refused(r"needs a.set beside it", ml.Timestamps.load, tmp_path / "a.spc")


def test_sdt(tmp_path):
    """An image of 3 x 4 pixels and 256 bins of an SPC-150 (SPC_data_file_structure.h)."""
    pytest.importorskip("sdtfile", reason="sdtfile (extra io) is not installed")
    counts = np.random.default_rng(1).poisson(2.0, (3, 4, 256)).astype("<u2")
    info = b"*IDENTIFICATION\r\n  ID        : SPC Setup & Data File\r\n  Title     : t\r\n*END\r\n"
    setup = b"*SETUP\r\n  SYS_PARA_BEGIN:\r\n  SYS_PARA_END:\r\n*END\r\n"
    measured = struct.pack(
        "<9s11s16sh5fhffhfffhhhhHffhBhHfhhh16sf4hhh4ifhh4i",
        *(b"", b"", b"", 0, *[0.0] * 5, 1, 0.0, 50e-9, 2, 0.0, 0.0, 0.0, 256, 0, 1, 1, 1, 0.0, 0.0, 0, 0, 0, 0),
        *(0.0, 0, 0, 0, b"SPC-150", 0.0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0.0, 0, 0, 4, 3, 1, 1),
    )
    place = 42 + len(info)
    desc = place + len(setup)
    data = desc + len(measured)
    header = struct.pack(
        "<hihiHihIihhHIHH",
        *((0x28 << 4) | 15, 42, len(info), place, len(setup), data, 1, counts.nbytes, desc, 1, len(measured)),
        *(0x5555, 0, 0, 0x55AA),
    )
    block = struct.pack("<BBIIHhII", 0, 0, data + 22, 0, 0x11, 0, 0, counts.nbytes)
    path = tmp_path / "a.sdt"
    path.write_bytes(header + info + setup + measured + block + counts.tobytes())
    result = recorded(path)
    assert result.bin_ns == pytest.approx(50.0 / 2 / 256)
    assert np.array_equal(result.arrays["block 0"], counts)
    system = make_system(40.0, 1000, 256, sigma_ns=0.3, period_ns=25.0)
    assert np.array_equal(io.foreign_cube(path, system).histogram[0], counts)
    path.write_bytes(path.read_bytes()[:200])
    refused(r"a\.sdt", io.foreign_cube, path, system)


def scanned(tmp_path: Path) -> tuple[Path, np.ndarray]:
    """A scanned image by another program: 2 frames of 3 x 4 pixels, 100 bins, two channels, 500 periods each."""
    import ptufile

    counts = np.random.default_rng(2).poisson(1.5, (2, 3, 4, 2, 100)).astype(np.uint16)
    path = tmp_path / "scan.ptu"
    ptufile.imwrite(path, counts, 50e-9, 0.5e-9, pixel_time=500 * 50e-9)
    return path, counts


def test_scanned_image(tmp_path):
    path, counts = scanned(tmp_path)
    result = recorded(path)
    assert (result.bin_ns, result.period_ns, result.cycles) == (pytest.approx(0.5), pytest.approx(50.0), 500)
    assert result.notes == ()
    for k in range(2):
        assert np.array_equal(result.arrays[f"channel {k}"], counts[:, :, :, k])
    system = SYSTEM.replace(bins=100, cycles=500, detector=ml.Detector(dead_time_ns=0.0))
    refused("several arrays, give variable: channel 0", io.foreign_cube, path, system)
    cube = io.foreign_cube(path, system, variable="channel 1")
    assert np.array_equal(cube.histogram, counts[:, :, :, 1])
    refused("is an image of another program", ml.Timestamps.load, path)


def test_a_laser_scanning_pt3(tmp_path):
    """Markers of frame, line start and line stop among the records, channel 15 with the marker in the data bits."""
    line, dwell, rows, columns = 40, 10, 2, 4  # laser periods
    records, image = [], np.zeros((rows, columns, 3125), np.int64)
    random = np.random.default_rng(4)
    for y in range(rows):
        begin = 100 + y * 2 * line
        records.append((begin, (0xF << 28) | (2 << 16)))
        for period in np.sort(random.choice(line, 25, replace=False)):
            fine = int(random.integers(3125))
            records.append((begin + int(period), (1 << 28) | (fine << 16)))
            image[y, period // dwell, fine] += 1
        records.append((begin + line, (0xF << 28) | (4 << 16)))
    records.append((100 + rows * 2 * line, (0xF << 28) | (1 << 16)))
    words = np.array([word | clock for clock, word in records])
    header = pico_header(3, words.size, (3, 3, 1, 2, 3, 0, columns, rows))
    path = tmp_path / "scan.pt3"
    path.write_bytes(header + words.astype("<u4").tobytes())
    result = recorded(path)
    assert result.cycles == dwell
    (name,) = result.arrays
    assert name == "channel 0"
    assert np.array_equal(result.arrays[name], image)


def test_commands_take_them(tmp_path):
    """`info` lists channels, `calibrate` takes a channel, `reconstruct` and `convert` the histograms."""
    path = pt3(tmp_path / "a.pt3")
    printed = ok("info", path)
    channel = parts(0.016)[2]
    assert f"0: {int((channel == 0).sum()):,} photons" in printed.output
    assert f"2: {int((channel == 2).sum()):,} photons" in printed.output
    printed = ok("calibrate", path, "--pixel", "0,2", "--look")
    assert "rate" in printed.output
    scan, counts = scanned(tmp_path)
    known = ["--variable", "channel 0", "--dead-time-ns", "0", "--pulse-sigma-ns", "0.5"]
    ok("reconstruct", scan, *known, "-o", tmp_path / "maps.npz")
    ok("convert", scan, tmp_path / "cube.zarr", *known)
    cube = io.load(tmp_path / "cube.zarr")
    assert np.array_equal(cube.histogram[:], counts[:, :, :, 0])
    assert (cube.system.cycles, cube.system.bins, cube.system.period_ns) == (500, 100, pytest.approx(50.0))


def test_cut_short_and_unknown(tmp_path):
    path = pt3(tmp_path / "a.pt3")
    whole = path.read_bytes()
    path.write_bytes(whole[:-40])
    refused(r"a\.pt3 is cut short: its header states \d+ records", ml.Timestamps.load, path)
    path.write_bytes(whole[:400])
    refused(r"a\.pt3", ml.Timestamps.load, path)
    path.write_bytes(b"something else" + whole[14:])
    refused(r"a\.pt3 is no \.pt3: it begins with b'something else", ml.Timestamps.load, path)
