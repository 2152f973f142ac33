"""Results of the paper, for comparison."""

from collections.abc import Mapping

Rates = Mapping[tuple[str, float], tuple[float, float, float]]

# Success, timeout and collision in percent of 500 episodes, by method and P(conservative); paper Fig. 4.
RATES_PERCENT: Rates = {
    ("oracle", 0.25): (85, 1, 14),
    ("oracle", 0.4): (90, 4, 5),
    ("oracle", 0.6): (98, 0, 2),
    ("no_labels", 0.25): (74, 6, 20),
    ("no_labels", 0.4): (80, 18, 2),
    ("no_labels", 0.6): (91, 9, 0),
    ("vae", 0.25): (81, 16, 3),
    ("vae", 0.4): (91, 2, 7),
    ("vae", 0.6): (97, 2, 1),
    ("morton", 0.4): (87, 6, 7),
}
