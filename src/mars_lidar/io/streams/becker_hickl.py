"""Photons of Becker & Hickl's recorders: .spc."""

from pathlib import Path

import numpy as np

from mars_lidar._base.imports import needed
from mars_lidar.io.streams.photons import Photons

_SYNC = 1  # SP_MST_CLK: the macro clock is the laser's sync; 0: one of its own, others: the sync divided
_MARKER_WRAP = 0xD  # a marker with an overflow: phconvert 0.10 reads its bits as the number of overflows


def photons(path: Path) -> Photons:
    """Becker & Hickl's FIFO records; phconvert reads them with the .set that SPCM writes beside them."""
    reader = needed("phconvert.bhreader", "a .spc")
    settings = next((each for each in map(path.with_suffix, (".set", ".SET")) if each.is_file()), None)
    if settings is None:
        raise ValueError(
            f"{path} needs {path.with_suffix('.set').name} beside it: it tells the card and its time range"
        )
    code = int(reader.load_set(settings)["header"][0]["revision"] & 0xFF0) >> 4
    card = reader._spc_codes.get(code, f"of code {code:#x}")
    kind = "SPC-1XX" if card == "SPC-140" else "auto"  # phconvert knows the card, but not that it is of this kind
    if reader._spc_types.get(card) in (None, "NotSup", "DPC-230"):
        raise ValueError(f"{path} is of a card {card}, whose records phconvert does not read")
    if kind == "SPC-1XX" or reader._spc_types[card] == "SPC-1XX":
        words = np.fromfile(path, "<u4")[1:]
        if (words >> 28 == _MARKER_WRAP).any():
            raise ValueError(f"{path} has markers of a scan, which phconvert misreads: save it as .sdt or export times")
    recording = reader.load_spc(path, settings, kind)
    data, setup = recording["photon_data"], recording["meta"]["setup"]
    photon = ~np.isin(data["detectors"], data["marker_ids"])
    clock_ns = 1e9 * float(data["timestamps_unit"])
    bins = int(data.get("tcspc_num_bins", 4096))
    fine_ns = 1e9 * float(setup.get("SP_TAC_R", 0.0)) / float(setup.get("SP_TAC_G", 1) or 1) / bins
    if not fine_ns > 0.0:
        raise ValueError(f"{settings} does not state the time range, SP_TAC_R")
    return Photons(
        np.asarray(data["timestamps"][photon], np.int64),
        clock_ns,
        np.asarray(data["detectors"][photon], np.int64),
        str(path),
        np.asarray(data["nanotimes"][photon], np.int64),
        fine_ns,
        clock_ns if setup.get("SP_MST_CLK") == _SYNC else None,
    )
