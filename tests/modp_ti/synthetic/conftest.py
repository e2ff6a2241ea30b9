"""Taichi on the CPU and one room for all tests of the demo sequence."""

from __future__ import annotations

import pytest
