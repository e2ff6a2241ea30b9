"""The arithmetic of the report on the GPU's kernels: occupancy, the assembler's report, machine code and work."""

from __future__ import annotations

import numpy as np
import pytest
from gpu_kernels.estimate import Card, count_work, milliseconds
from gpu_kernels.machine_code import Counts, instructions_of, loop_counts
from gpu_kernels.occupancy import ARCHITECTURES, blocks_per_multiprocessor, limit, occupancy
from gpu_kernels.toolkit import Assembled, parse_ptxas
from step import Size

from modp_ti.files.errors import InputError

# (architecture, threads, registers, shared memory) and the blocks on a multiprocessor, by NVIDIA's own calculator
# (cuda_occupancy.h of CUDA 13.0, with the largest carve-out of shared memory).
BLOCKS = [
    (75, 256, 48, 11272, 4), (75, 256, 80, 38656, 1), (75, 96, 37, 3000, 10), (75, 256, 56, 20000, 3),
    (75, 64, 16, 0, 16), (86, 256, 48, 11272, 5), (86, 256, 80, 38656, 2), (86, 1024, 63, 0, 1), (86, 64, 16, 0, 16),
    (86, 128, 128, 1000, 4), (89, 64, 16, 0, 24), (89, 32, 20, 512, 24), (89, 256, 255, 0, 1), (90, 256, 48, 11272, 5),
    (90, 256, 80, 38656, 3), (90, 256, 91, 38656, 2), (90, 96, 37, 3000, 16), (90, 256, 64, 16384, 4),
    (90, 32, 20, 512, 32), (100, 128, 32, 0, 16), (100, 256, 56, 20000, 4), (120, 256, 91, 38656, 2),
    (120, 128, 32, 0, 12), (120, 64, 16, 0, 24),
]  # fmt: skip

PTXAS = """\
ptxas warning : Unresolved extern variable 'shared_array_27' in whole program compilation, ignoring extern qualifier
ptxas info    : 0 bytes gmem
ptxas info    : Compiling entry function '_forward_c172_0_kernel_1_range_for' for 'sm_90'
ptxas info    : Function properties for _forward_c172_0_kernel_1_range_for
    0 bytes stack frame, 0 bytes spill stores, 0 bytes spill loads
ptxas info    : Used 47 registers, used 1 barriers, 11272 bytes smem, 384 bytes cmem[0]
ptxas info    : Compile time = 15.427 ms
ptxas info    : Compiling entry function '_mark_c92_0_kernel_0_serial' for 'sm_90'
ptxas info    : Function properties for _mark_c92_0_kernel_0_serial
    96 bytes stack frame, 8 bytes spill stores, 12 bytes spill loads
ptxas info    : Used 20 registers, used 0 barriers
"""

# A loop over batches (.L_x_1) around one over Gaussians (.L_x_2), which a Gaussian leaves at once if it misses, and one
# over rows (.L_x_4), unrolled twice.
CODE = """\
//--------------------- .text.other --------------------------
other:
        /*0000*/                   EXIT ;
//--------------------- .text.kernel --------------------------
	.sectioninfo	@"SHI_REGISTERS=47"
kernel:
        /*0000*/                   LDC R1, c[0x0][0x28] ;
.L_x_1:
        /*0010*/                   STS [R2], R3 ;
        /*0020*/                   BAR.SYNC.DEFER_BLOCKING 0x0 ;
.L_x_2:
        /*0030*/                   LDS R5, [R4] ;
        /*0040*/              @!P0 BRA `(.L_x_3) ;
        /*0050*/                   LDS.64 R6, [R4+0x8] ;
        /*0060*/                   FMUL.FTZ R6, R6, R7 ;
        /*0070*/                   MUFU.EX2 R6, R6 ;
.L_x_3:
        /*0080*/                   VIADD R4, R4, 0x4 ;
        /*0090*/               @P1 BRA `(.L_x_2) ;
.L_x_4:
        /*00a0*/                   I2FP.F32.S32 R8, R9 ;
        /*00b0*/                   LDS R10, [R11] ;
        /*00c0*/                   I2FP.F32.S32 R12, R13 ;
        /*00d0*/                   LDS R14, [R15] ;
        /*00e0*/                   FADD.FTZ R10, R10, R14 ;
        /*00f0*/                   BRA P2, `(.L_x_4) ;
        /*0100*/               @P3 BRA `(.L_x_1) ;
        /*0110*/                   EXIT ;
.L_x_5:
        /*0120*/                   BRA `(.L_x_5);
        /*0130*/                   NOP;
"""


@pytest.mark.parametrize(("capability", "threads", "registers", "shared", "blocks"), BLOCKS)
def test_as_many_blocks_fit_as_nvidias_calculator_says(
    capability: int, threads: int, registers: int, shared: int, blocks: int
) -> None:
    assert blocks_per_multiprocessor(ARCHITECTURES[capability], threads, registers, shared) == blocks


def test_occupancy_is_the_share_of_the_warps_and_names_what_limits_it() -> None:
    hopper = ARCHITECTURES[90]
    assert occupancy(hopper, 256, 80, 38656) == 3 * 8 / 64
    assert limit(hopper, 256, 80, 38656) == "registers"
    assert limit(hopper, 256, 32, 100_000) == "shared memory"
    assert limit(hopper, 32, 16, 0) == "blocks"
    assert occupancy(hopper, 1024, 32, 0) == 1.0


def test_the_assemblers_report_is_read_entry_by_entry() -> None:
    assert parse_ptxas(PTXAS) == {
        "_forward_c172_0_kernel_1_range_for": Assembled(registers=47, shared=11272, spilled=0, stack=0),
        "_mark_c92_0_kernel_0_serial": Assembled(registers=20, shared=0, spilled=20, stack=96),
    }


def test_instructions_are_counted_by_the_loop_that_they_are_in() -> None:
    counts = loop_counts(instructions_of(CODE, "kernel"))
    assert counts.hit == Counts(7, 2, 1)
    assert counts.missed == Counts(4, 1, 0)
    assert counts.row == Counts(3, 1, 0)
    assert counts.batch == Counts(3, 1, 0)
    assert counts.tile == Counts(2, 0, 0)


def test_code_without_the_loop_is_refused() -> None:
    with pytest.raises(InputError, match="no code of missing"):
        instructions_of(CODE, "missing")
    with pytest.raises(InputError, match="no loop over Gaussians"):
        loop_counts(instructions_of(CODE, "other"))


def test_work_is_that_of_warps_of_two_rows() -> None:
    rng = np.random.default_rng(0)
    per_tile = rng.integers(0, 9, 40)
    first = rng.integers(0, 16, per_tile.sum())
    last = np.minimum(first + rng.integers(0, 9, len(first)), 15)
    packed = np.where(rng.random(len(first)) < 0.1, 0, first | (last + 1) << 16).astype(np.int32)
    hits, rows, pixels, k = 0, 0, 0, 0
    for n in per_tile:
        reached = [set(range(span & 0xFFFF, span >> 16)) for span in packed[k : k + n].tolist()]
        for these in reached:
            hits += len({row // 2 for row in these})
            pixels += 16 * len(these)
        for pair in range(0, n, 2):
            rows += max(len(these) for these in reached[pair : pair + 2])
        k += n
    work = count_work(Size(16, 640, 100), per_tile.astype(np.int32), packed)
    assert (work.tiles, work.pairs, work.hits, work.rows, work.pixel_pairs) == (40, k, hits, rows, pixels)
    assert work.batches == {"forward": np.count_nonzero(per_tile), "backward": np.count_nonzero(per_tile)}


def test_time_follows_from_the_unit_that_is_busy_longest() -> None:
    card = Card("two multiprocessors", 90, 2, 1e9, 1e12)
    assert milliseconds(card, Counts(8e6, 1e6, 0.5e6)) == pytest.approx(1.0)
    assert milliseconds(card, Counts(8e6, 4e6, 0.5e6)) == pytest.approx(2.0)
    assert milliseconds(card, Counts(8e6, 4e6, 4e6)) == pytest.approx(4.0)
