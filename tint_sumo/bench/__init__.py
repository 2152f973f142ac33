"""Measurements of speed and memory on this machine (``tint-sumo bench``)."""

from tint_sumo.bench.benchmark import QUICK, Benchmark, Sizes, run_benchmark

__all__ = ["QUICK", "Benchmark", "Sizes", "run_benchmark"]
