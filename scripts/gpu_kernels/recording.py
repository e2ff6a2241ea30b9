"""Records the PTX and the launches of every kernel of a mapping step, on a stand-in for the CUDA driver."""

from __future__ import annotations

import gc
import json
import os
import subprocess
import sys
import tempfile
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

from modp_ti.files.errors import InputError

SOURCE = Path(__file__).with_name("stand_in_driver.c")
PROJECT = Path(__file__).resolve().parents[2]
# Where the driver writes, and the compute capability of the device that it presents.
FOLDER, CAPABILITY = "MODP_PTX_FOLDER", "MODP_PTX_CAPABILITY"
# Names under which the engines look for the driver.
LIBRARIES = ("libcuda.so.1", "libcuda.so")


@dataclass(frozen=True)
class Launch:
    """A launched task of a kernel.

    Attributes:
        entry: Name of its entry in the PTX.
        threads: Threads of a block.
        shared: Dynamic shared memory of a block [bytes].
    """

    entry: str
    threads: int
    shared: int


@dataclass(frozen=True)
class Recording:
    """What an engine handed to the driver.

    Attributes:
        modules: Files of the modules in PTX.
        launches: Number of launches of each task.
        step: Number of launches of each task in one optimisation step.
        names: Qualified names of the Python kernels by the beginning of their entries' names.
    """

    modules: list[Path]
    launches: Counter[Launch]
    step: Counter[Launch]
    names: dict[str, str]

    def target(self) -> str:
        """PTX version and target of the modules, for example "PTX 7.8 for sm_90"."""
        words = [line.split() for line in self.modules[-1].read_text().splitlines()[:12] if line.startswith(".")]
        said = {word[0]: word[1] for word in words}
        return f"PTX {said['.version']} for {said['.target'].rstrip(',')}"

    def name(self, entry: str) -> str | None:
        """Class and function of an entry's kernel; None for the engine's own kernels and for serial tasks.

        A kernel's first task may be serial: one thread that computes the bounds of the loop. The tasks after the first
        loop get their number, and so do the further variants of a kernel with templates.
        """
        kernel, _, task = entry.partition("_kernel_")
        stem, _, variant = kernel.removesuffix("_reverse_grad").rpartition("_")
        if stem not in self.names or not task.endswith("range_for"):
            return None
        reverse = ", reverse" if kernel.endswith("_reverse_grad") else ""
        number = int(task.split("_")[0])
        loop = f", loop {number}" if number > 1 else ""
        return self.names[stem] + reverse + loop + (f", variant {int(variant) + 1}" if variant != "0" else "")


def record(engine: str, capability: int, folder: Path) -> Recording:
    """Compile the kernels for a compute capability, in a process of its own.

    Args:
        engine: Package of the engine, "taichi" or "quadrants".
        capability: Compute capability, for example 90.
        folder: Empty folder for the modules.

    Raises:
        InputError: If the driver's stand-in cannot be compiled, or the engine does not start on it.
    """
    if sys.platform != "linux":
        raise InputError("the stand-in for the CUDA driver is a Linux library: run scripts/gpu_report on Linux")
    with tempfile.TemporaryDirectory() as libraries:
        _compile_driver(Path(libraries))
        environment = os.environ | {
            "MODP_ENGINE": engine,
            FOLDER: str(folder),
            CAPABILITY: str(capability),
            "LD_LIBRARY_PATH": f"{libraries}:{os.environ.get('LD_LIBRARY_PATH', '')}",
            "PYTHONPATH": f"{PROJECT / 'scripts'}:{PROJECT}",
            # Modules that the engine finds in its cache would be written all the same, but those of other sources too.
            "TI_OFFLINE_CACHE_FILE_PATH": f"{libraries}/cache",
            "QD_OFFLINE_CACHE_FILE_PATH": f"{libraries}/cache",
        }
        command = [sys.executable, "-c", "from gpu_kernels.recording import recorded; recorded()"]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    if done.returncode != 0 or not (folder / "kernels.json").exists():
        last = (done.stderr.strip() or done.stdout.strip() or f"exit code {done.returncode}").splitlines()[-1]
        raise InputError(f"{engine} does not run on the stand-in for the CUDA driver ({last}); see {SOURCE}")
    told = json.loads((folder / "kernels.json").read_text())
    lines = [line.split() for line in (folder / "launches.txt").read_text().splitlines()]
    launches = [Launch(entry, int(threads), int(shared)) for entry, threads, shared in lines]
    first, last = told["step"]
    return Recording(sorted(folder.glob("*.ptx")), Counter(launches), Counter(launches[first:last]), told["names"])


def _compile_driver(folder: Path) -> None:
    command = ["cc", "-O1", "-shared", "-fPIC", "-o", str(folder / LIBRARIES[0]), str(SOURCE)]
    try:
        subprocess.run(command, check=True, capture_output=True, text=True)
    except FileNotFoundError:
        raise InputError("a C compiler is needed: sudo apt-get install gcc libc6-dev") from None
    except subprocess.CalledProcessError as error:
        raise InputError(f"{SOURCE.name} does not compile: {error.stderr.strip().splitlines()[0]}") from error
    for name in LIBRARIES[1:]:
        (folder / name).symlink_to(LIBRARIES[0])


def recorded() -> None:
    """Compile and launch the kernels on the stand-in; runs in the process that `record` starts.

    PyTorch knows nothing of the stand-in, so its tensors stay on the CPU. The stand-in takes their addresses for the
    device's. Nothing runs, so that memory which a kernel would have filled must not be left uninitialised.
    """
    import numpy as np
    import torch

    from fields.runtime import backend

    torch.cuda.is_available = lambda: True
    torch.empty, np.empty = torch.zeros, np.zeros  # type: ignore[assignment]
    backend.torch_device = lambda: torch.device("cpu")
    backend.without_waiting = torch.from_numpy  # type: ignore[assignment]

    from fields.frames.tracked_frame import TrackedFrame
    from fields.geometry.camera import PinholeCamera
    from fields.map.keyframes import KeyframeStore
    from fields.runtime.engine import engine
    from pipelines.online import OnlineMapper
    from pipelines.settings import MappingSettings

    backend.initialise("cuda")
    mapper = OnlineMapper(MappingSettings(), 480, 270)
    mapper.compile()
    # What the warm-up leaves out: the bricks of the voxels, and gradients of depth.
    if mapper.densifier.voxels is not None:
        mapper.densifier.voxels.admit(np.zeros((1, 3)), 1.0)
    camera = PinholeCamera(400.0, 400.0, 240.0, 135.0, 480, 270)
    image = np.zeros((270, 480, 3), dtype=np.float32)
    store = KeyframeStore()
    for i in range(2):
        store.append(TrackedFrame(i, 0.0, "stand-in", image, camera, np.eye(4)))
    mapper.gaussians.append(
        np.zeros((4, 3)), np.zeros((4, 3)), np.ones((4, 4)), np.zeros(4), np.zeros((4, mapper.gaussians.sh_count, 3))
    )
    mapper.optimiser.step(store, [1], mapper.optimiser.rates(1.0), pose_rate=1.0)
    mapper.renderer.backward(with_depth=True)

    folder = Path(os.environ[FOLDER])
    cuts = [_launches(folder)]
    mapper.optimiser.step(store, [1], mapper.optimiser.rates(1.0), pose_rate=1.0)
    cuts.append(_launches(folder))
    names = {
        f"{kernel.func.__name__}_c{kernel.kernel_counter}": kernel.func.__qualname__
        for kernel in gc.get_objects()
        if type(kernel).__name__ == "Kernel" and type(kernel).__module__.startswith(engine().package)
    }
    (folder / "kernels.json").write_text(json.dumps({"step": cuts, "names": names}))


def _launches(folder: Path) -> int:
    return len((folder / "launches.txt").read_text().splitlines())
