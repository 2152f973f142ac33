"""Ctrl-C at a chosen moment."""

import pytest

from tint_sumo.traits.vae import Vae


def interrupt_at_step(monkeypatch: pytest.MonkeyPatch, step: int) -> None:
    """Press Ctrl-C in the middle of training, before the given gradient step."""
    original, calls = Vae.loss, iter(range(step))

    def loss(self, *args):
        if next(calls, None) is None:
            raise KeyboardInterrupt
        return original(self, *args)

    monkeypatch.setattr(Vae, "loss", loss)
