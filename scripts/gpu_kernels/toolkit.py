"""NVIDIA's assembler and disassembler: where they come from, and what they say of a module."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

from modp_ti.files.errors import InputError

# Wheels with the tools. PTX for sm_120 needs CUDA 12.8 or newer, and CUDA 13 still has sm_75.
WHEELS = {"ptxas": "nvidia-cuda-nvcc==13.0.88", "nvdisasm": "nvidia-cuda-nvdisasm==13.5.37"}
ENTRY = re.compile(r"Compiling entry function '(\S+)' for '(\S+)'")
MEMORY = re.compile(r"(\d+) bytes stack frame, (\d+) bytes spill stores, (\d+) bytes spill loads")
USED = re.compile(r"Used (\d+) registers")
SHARED = re.compile(r"(\d+) bytes smem")


@dataclass(frozen=True)
class Assembled:
    """What the assembler reports of an entry.

    Attributes:
        registers: Registers of a thread.
        shared: Static shared memory of a block [bytes].
        spilled: Spilled bytes of a thread, stored and loaded.
        stack: Local memory of a thread, spills included [bytes].
    """

    registers: int
    shared: int
    spilled: int
    stack: int


def tool(name: str) -> Path:
    """Return the path of "ptxas" or "nvdisasm": from PATH, or else from NVIDIA's wheel, which is fetched once.

    The wheels are unpacked below `~/.cache/modp-ti` (or XDG_CACHE_HOME), outside the environment of the project.

    Raises:
        InputError: If the tool is neither installed nor can be fetched.
    """
    installed = shutil.which(name)
    if installed:
        return Path(installed)
    cache = (
        Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "modp-ti" / WHEELS[name].replace("==", "-")
    )
    found = sorted(cache.glob(f"nvidia/**/bin/{name}"))
    if not found:
        print(f"fetching {name} ({WHEELS[name]}) ...", file=sys.stderr)
        command = [sys.executable, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--no-deps"]
        done = subprocess.run(
            [*command, "--target", str(cache), WHEELS[name]], capture_output=True, text=True, check=False
        )
        found = sorted(cache.glob(f"nvidia/**/bin/{name}"))
        if done.returncode != 0 or not found:
            raise InputError(f"{name} is missing: install the CUDA toolkit, or pip install {WHEELS[name]}")
        found[0].chmod(0o755)
    return found[0]


def version(name: str) -> str:
    """Return the release of a tool, for example "13.0.88"."""
    said = subprocess.run([tool(name), "--version"], capture_output=True, text=True, check=True).stdout
    return said.rpartition(" V")[2].split()[0]


def assemble(module: Path, capability: int, cubin: Path) -> dict[str, Assembled]:
    """Assemble a module, as the driver does when it loads the module on a device of that capability.

    Args:
        module: Module in PTX.
        capability: Compute capability, for example 90.
        cubin: File for the machine code.

    Returns:
        Report by the entry's name.

    Raises:
        InputError: If the module does not assemble.
    """
    command = [tool("ptxas"), "-v", "--gpu-name", f"sm_{capability}", module, "-o", cubin]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        fatal = next((line for line in done.stderr.splitlines() if "fatal" in line or "error" in line), "no message")
        raise InputError(f"{module} does not assemble for sm_{capability}: {fatal.strip()}")
    return parse_ptxas(done.stderr)


def parse_ptxas(text: str) -> dict[str, Assembled]:
    """Parse the output of `ptxas -v`.

    Returns:
        Report by the entry's name.
    """
    found: dict[str, Assembled] = {}
    entry, stack, spilled = "", 0, 0
    for line in text.splitlines():
        if match := ENTRY.search(line):
            entry, stack, spilled = match[1], 0, 0
        elif match := MEMORY.search(line):
            # Also printed for functions that are not inlined; their memory counts for the entry that is being compiled.
            stack, spilled = max(stack, int(match[1])), spilled + int(match[2]) + int(match[3])
        elif (match := USED.search(line)) and entry:
            shared = SHARED.search(line)
            found[entry] = Assembled(int(match[1]), int(shared[1]) if shared else 0, spilled, stack)
            entry = ""
    return found


def disassemble(cubin: Path) -> str:
    """Return the disassembled machine code of a file, with labels."""
    return subprocess.run([tool("nvdisasm"), "-c", cubin], capture_output=True, text=True, check=True).stdout
