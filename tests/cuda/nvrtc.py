"""NVRTC through its C interface: the kernels for a GPU compiled where there is none, and what ptxas says of them."""

import ctypes
import re
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

from mars_lidar.engines.cuda.kernels import HEADERS, OPTIONS, Kernel, source


class NotFound(RuntimeError):
    """The library is not installed."""


@dataclass(frozen=True)
class Resources:
    """What one kernel takes on one architecture."""

    registers: int
    stack_bytes: int
    spill_stores: int
    spill_loads: int
    code_bytes: int  # machine instructions are 16 bytes

    @property
    def instructions(self) -> int:
        return self.code_bytes // 16


def version() -> str:
    return metadata.version("nvidia-cuda-nvrtc")


def library() -> ctypes.CDLL:
    """The NVRTC of the wheel nvidia-cuda-nvrtc."""
    try:
        files = metadata.files("nvidia-cuda-nvrtc") or []
    except metadata.PackageNotFoundError:
        raise NotFound("NVRTC is not installed: pip install nvidia-cuda-nvrtc") from None
    here = [Path(str(file.locate())) for file in files]
    main = [p for p in here if re.fullmatch(r"libnvrtc\.so\.\d+|nvrtc64_\d+_0\.dll", p.name)]
    parts = [p for p in here if re.fullmatch(r"libnvrtc-builtins\.so\.[\d.]+|nvrtc-builtins64_\d+\.dll", p.name)]
    if not main or not parts:
        raise NotFound("the wheel nvidia-cuda-nvrtc has no library for this machine")
    ctypes.CDLL(str(parts[0]), mode=ctypes.RTLD_GLOBAL)  # which NVRTC does not look for beside itself
    return ctypes.CDLL(str(main[0]))


def compiled(kernels: list[Kernel], architecture: str) -> dict[Kernel, Resources]:
    """Compile to machine code for one architecture, such as ``sm_90``; RuntimeError with the log where that fails."""
    headers = dict.fromkeys(kernel.header for kernel in kernels)
    estimate: dict[Kernel, Resources] = {}
    for header in headers:
        some = {kernel.expression: kernel for kernel in kernels if kernel.header == header}
        estimate |= {some[name]: used for name, used in compiled_code(source(header), list(some), architecture).items()}
    return estimate


def compiled_code(code: str, expressions: list[str], architecture: str) -> dict[str, Resources]:
    """The same of kernels of one source, by their names in C++."""
    nvrtc, program = library(), ctypes.c_void_p()
    _check(nvrtc.nvrtcCreateProgram(ctypes.byref(program), code.encode(), b"kernel.cu", 0, None, None), "")
    try:
        for expression in expressions:
            _check(nvrtc.nvrtcAddNameExpression(program, expression.encode()), expression)
        words = (*OPTIONS, f"-I{HEADERS}", f"--gpu-architecture={architecture}", "--ptxas-options=-v")
        options = [word.encode() for word in words]
        result = nvrtc.nvrtcCompileProgram(program, len(options), (ctypes.c_char_p * len(options))(*options))
        log = _text(nvrtc, program, "ProgramLog").decode()
        _check(result, log)
        cubin = _text(nvrtc, program, "CUBIN")
        estimate = {}
        for expression in expressions:
            name = ctypes.c_char_p()
            _check(nvrtc.nvrtcGetLoweredName(program, expression.encode(), ctypes.byref(name)), log)
            assert name.value is not None
            estimate[expression] = _resources(log, cubin, name.value.decode())
        return estimate
    finally:
        nvrtc.nvrtcDestroyProgram(ctypes.byref(program))


def _check(result: int, log: str) -> None:
    if result != 0:
        raise RuntimeError(f"NVRTC failed ({result}): {log}")


def _text(nvrtc: ctypes.CDLL, program: ctypes.c_void_p, what: str) -> bytes:
    size = ctypes.c_size_t()
    _check(getattr(nvrtc, f"nvrtcGet{what}Size")(program, ctypes.byref(size)), what)
    buffer = ctypes.create_string_buffer(size.value)
    _check(getattr(nvrtc, f"nvrtcGet{what}")(program, buffer), what)
    return buffer.raw[: size.value].rstrip(b"\0") if what == "ProgramLog" else buffer.raw


def _resources(log: str, cubin: bytes, kernel: str) -> Resources:
    """From what ptxas logs of one kernel, and the length of its code."""
    said = log.split(f"Compiling entry function '{kernel}'", 1)[1].split("Compiling entry function", 1)[0]

    def number(pattern: str) -> int:
        estimate = re.search(pattern, said)
        if estimate is None:
            raise RuntimeError(f"ptxas did not tell {pattern!r}: {said}")
        return int(estimate[1])

    return Resources(
        registers=number(r"Used (\d+) registers"),
        stack_bytes=number(r"(\d+) bytes stack frame"),
        spill_stores=number(r"(\d+) bytes spill stores"),
        spill_loads=number(r"(\d+) bytes spill loads"),
        code_bytes=_section_bytes(cubin, f".text.{kernel}"),
    )


def _section_bytes(elf: bytes, wanted: str) -> int:
    """Size of a section of a 64-bit little-endian ELF file."""

    def at(place: int, size: int) -> int:
        return int.from_bytes(elf[place : place + size], "little")

    table, size, number, names = at(0x28, 8), at(0x3A, 2), at(0x3C, 2), at(0x3E, 2)
    strings = at(table + names * size + 0x18, 8)
    for k in range(number):
        header = table + k * size
        start = strings + at(header, 4)
        if elf[start : elf.index(b"\0", start)].decode() == wanted:
            return at(header + 0x20, 8)
    raise RuntimeError(f"the compiled code has no section {wanted}")
