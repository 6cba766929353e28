"""Hypothesis draws what is done to a good file: to its bytes, or to what they mean."""

import json
import math
import re
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from hypothesis import strategies as st

from mars_lidar._base import manifest

_ODD = [0, 1, 255, 2**16 - 1, 2**31 - 1, 2**31, 2**32 - 1, 2**63 - 1, 2**63, 2**64 - 1]
_TEXTS = ["-1", "0", "1e400", "nan", "inf", "1e9", "99999999999999999999", "null", "[]", "{}", '"a"', "*a"]
_TEXTS += ["&a", "!!x", "1e7"]
_fraction = st.integers(0, 9999).map(lambda n: n / 10_000)
_bytes = st.one_of(
    st.tuples(st.just("flip"), _fraction, st.integers(0, 7)),
    st.tuples(st.just("byte"), _fraction, st.integers(0, 255)),
    st.tuples(st.just("number"), _fraction, st.sampled_from(_ODD), st.sampled_from([2, 4, 8]), st.booleans()),
    st.tuples(st.just("cut"), _fraction, st.integers(1, 64)),
    st.tuples(st.just("repeat"), _fraction, st.integers(1, 64), st.integers(1, 40)),
    st.tuples(st.just("insert"), _fraction, st.binary(min_size=1, max_size=16)),
    st.tuples(st.just("end"), _fraction),
    st.tuples(st.just("zeros"), _fraction, st.integers(1, 512)),
)
_values = st.recursive(
    st.one_of(
        st.none(),
        st.booleans(),
        st.integers(),
        st.floats(),
        st.text(max_size=5),
        st.sampled_from([-1, 0, 1e7, 2**40, 1e300]),
    ),
    lambda inner: st.one_of(st.lists(inner, max_size=3), st.dictionaries(st.text(max_size=4), inner, max_size=3)),
    max_leaves=6,
)
edits = st.fixed_dictionaries(
    {
        "bytes": st.lists(_bytes, min_size=1, max_size=4),
        "meaning": st.booleans(),  # change what a container means, where it is one; else its bytes
        "where": st.lists(_fraction, min_size=8, max_size=8),
        "value": _values,
        "text": st.sampled_from(_TEXTS),
        "reseal": st.booleans(),  # of a store: with a manifest that agrees
    }
)


def apply(path: Path, edit: dict[str, Any]) -> None:
    """Change the file, or a file of the store, in place."""
    where = edit["where"]
    if path.is_dir():
        store, files = path, sorted(file for file in path.rglob("*") if file.is_file())
        path = files[int(where[0] * len(files))]
        if edit["meaning"] and path.suffix == ".json":
            path.write_text(json.dumps(_other(json.loads(path.read_text()), edit)))
        else:
            _edit_bytes(path, edit)
        if edit["reseal"] and path.name != manifest.NAME:
            _reseal(store)
        return
    meaning = {".npz": _npz, ".json": _json, ".yaml": _words, ".csv": _words, ".txt": _words}
    meaning |= dict.fromkeys((".h5", ".hdf5"), _hdf5) | ({".mat": _hdf5} if _is_hdf5(path) else {})
    if edit["meaning"] and path.suffix in meaning:
        try:
            meaning[path.suffix](path, edit)
            return
        except (ValueError, TypeError, OSError, OverflowError):  # what was drawn does not fit this file
            pass
    _edit_bytes(path, edit)


def _edit_bytes(path: Path, edit: dict[str, Any]) -> None:
    content = bytearray(path.read_bytes())
    for kind, at, *more in edit["bytes"]:
        k = int(at * max(1, len(content)))
        if kind in ("flip", "byte") and content:
            content[k] = content[k] ^ (1 << more[0]) if kind == "flip" else more[0]
        elif kind == "number":
            number, size, little = more
            content[k : k + size] = (number % 2 ** (8 * size)).to_bytes(size, "little" if little else "big")
        elif kind == "cut":
            del content[k : k + more[0]]
        elif kind == "repeat":
            content[k:k] = content[k : k + more[0]] * more[1]
        elif kind == "insert":
            content[k:k] = more[0]
        elif kind == "end":
            del content[k:]
        elif kind == "zeros":
            content[k : k + more[0]] = bytes(len(content[k : k + more[0]]))
    path.write_bytes(content)


def _array(values: np.ndarray, where: list[float]) -> np.ndarray:
    """Another array: of another type or shape, with odd values, or with a part missing."""
    kind, at = int(where[1] * 9), where[2]
    if kind == 0:
        return values.astype([np.uint8, np.float16, np.int64, "S3", "U2", np.complex128, bool, "<M8[s]"][int(at * 8)])
    if kind == 1:
        return values[..., None] if at < 0.5 else values.reshape(-1)
    if kind == 2:
        return values[: int(at * (len(values) + 1))] if values.ndim else np.array([values, values])
    if kind == 3:
        return np.zeros((0, *values.shape[1:]), values.dtype)
    if kind == 4 and values.dtype.kind == "U":
        text = str(values)
        k = int(at * len(text))
        return np.array(text[:k] + _TEXTS[int(where[3] * len(_TEXTS))] + text[k + 1 + int(where[4] * 6) :])
    out = values.copy().reshape(-1)
    if out.size and out.dtype.kind in "fiu":
        odd = [-1, 0, 2**31, 1e300, math.nan, math.inf, -math.inf, 1e7]
        with np.errstate(all="ignore"):
            out[int(at * out.size)] = np.array(odd[int(where[3] * 8)]).astype(out.dtype)
    return out.reshape(values.shape)


def _npz(path: Path, edit: dict[str, Any]) -> None:
    with np.load(path, allow_pickle=False) as archive:
        arrays = {name: archive[name] for name in archive.files}
    where = edit["where"]
    name = sorted(arrays)[int(where[0] * len(arrays))]
    if where[5] < 0.2:
        del arrays[name]
    else:
        with np.errstate(all="ignore"):
            arrays[name] = _array(arrays[name], where)
    np.savez_compressed(path, **arrays)
    if where[6] < 0.2:  # a header that claims more, in an archive that is whole
        with zipfile.ZipFile(path, "w") as archive, archive.open(f"{name}.npy", "w") as member:
            shape = (int(10 ** (15 * where[7])), 3)
            np.lib.format.write_array_header_1_0(member, {"descr": "<f8", "fortran_order": False, "shape": shape})
            member.write(bytes(100))


def _is_hdf5(path: Path) -> bool:
    import h5py

    return bool(h5py.is_hdf5(path))


def _hdf5(path: Path, edit: dict[str, Any]) -> None:
    import h5py

    where = edit["where"]
    with h5py.File(path, "r+") as file:
        names: list[str] = []
        file.visit(names.append)
        if not names:  # a link to another file alone
            return
        name = sorted(names)[int(where[0] * len(names))]
        attrs = file.attrs if where[5] < 0.3 else file[name].attrs
        keys = sorted(key for key in attrs if key not in ("CLASS", "NAME", "DIMENSION_LIST", "REFERENCE_LIST"))
        if where[6] < 0.4 and keys:
            key = keys[int(where[4] * len(keys))]
            value = attrs[key]
            del attrs[key]
            if where[1] > 0.2:
                text = edit["text"] if not isinstance(value, str) else value.replace(":", edit["text"], 1)
                attrs[key] = text if where[2] < 0.5 else 1e7
            return
        if not isinstance(file[name], h5py.Dataset) or where[6] < 0.5:
            del file[name]
            return
        values = np.asarray(file[name][()])
        del file[name]
        if where[7] < 0.15:
            file.create_dataset(name, (int(10 ** (12 * where[3])), 7, 7), "f8", chunks=(1, 7, 7), fillvalue=1.0)
        elif where[7] < 0.25:
            file.create_group(name)
        elif values.dtype.kind != "O":
            changed = _array(values, where)
            file[name] = changed.astype("S") if changed.dtype.kind in "UM" else changed


def _other(document: Any, edit: dict[str, Any]) -> Any:
    """The document with one value of it replaced, or gone."""
    places: list[tuple[Any, Any]] = []

    def walk(node: Any) -> None:
        for key in list(node) if isinstance(node, dict) else range(len(node)) if isinstance(node, list) else ():
            places.append((node, key))
            walk(node[key])

    walk(document)
    if not places:
        return edit["value"]
    node, key = places[int(edit["where"][3] * len(places))]
    if edit["where"][4] < 0.25:
        del node[key]
    else:
        node[key] = edit["value"]
    return document


def _json(path: Path, edit: dict[str, Any]) -> None:
    path.write_text(json.dumps(_other(json.loads(path.read_text()), edit)))


def _words(path: Path, edit: dict[str, Any]) -> None:
    """One word of a text replaced by another, or by an odd one."""
    text = path.read_text()
    words = list(re.finditer(r"[^\s,:\[\]{}=;]+", text))
    word = words[int(edit["where"][0] * len(words))]
    others = [edit["text"], words[int(edit["where"][1] * len(words))][0], "[" * 3000, "1" * 5000]
    path.write_text(text[: word.start()] + others[int(edit["where"][2] ** 3 * 4)] + text[word.end() :])


def _reseal(store: Path) -> None:
    """A manifest that agrees with what is there, as if it had been written so."""
    try:
        document = json.loads((store / "zarr.json").read_bytes())
        document["attributes"].pop("manifest", None)
        document.pop("consolidated_metadata", None)
        (store / "zarr.json").write_text(json.dumps(document))
        manifest.seal(store, {})
    except (ValueError, KeyError, TypeError, AttributeError, OSError):
        pass
