"""A browser of the system for tests of pages; none is ever downloaded."""

import shutil

import pytest

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
# Enough for a process of root in a container, and nothing that would ask the network on its own.
FLAGS = (
    *("--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync"),
)


def require_browser() -> str:
    """Path of a Chromium or Chrome; the tests are skipped where there is none."""
    for name in NAMES:
        if found := shutil.which(name):
            return found
    pytest.skip("no Chromium or Chrome on the PATH; install one (Debian: apt-get install chromium)")
