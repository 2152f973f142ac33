"""A study's report as one HTML file that needs nothing else: charts, an episode player and the latent spaces."""

from tint_sumo.study.page.writing import write_page as write_page

__all__ = ["write_page"]
