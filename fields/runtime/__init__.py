"""Taichi itself: how it starts, compiles, launches and reads back. All private use of it is here."""
