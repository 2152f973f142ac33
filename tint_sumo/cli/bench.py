"""``tint-sumo bench``."""

from dataclasses import dataclass

from tint_sumo.cli.command import Command, Outcome


@dataclass(frozen=True, kw_only=True)
class Bench(Command):
    """Measure the speed of environments, recorder and policies on this machine, beside that of SUMO alone."""

    quick: bool = False
    """Measure less, for a first look; without it the benchmark takes 2 to 4 minutes on a free machine."""

    def run(self) -> Outcome:
        from tint_sumo.bench import QUICK, Sizes, run_benchmark

        found = run_benchmark(QUICK if self.quick else Sizes())
        return Outcome(found.table(), found.to_json())
