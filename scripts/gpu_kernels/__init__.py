"""The GPU's kernels without a GPU: their PTX, what the assembler makes of it, and what follows for a card."""
