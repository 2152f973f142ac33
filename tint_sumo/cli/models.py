"""``tint-sumo models``."""

from dataclasses import dataclass
from typing import Annotated

from tyro.conf import Positional

from tint_sumo.cli.command import Command, Outcome
from tint_sumo.cli.values import optional

_NAME = optional("[NAME]", "Shipped model whose card is shown; a trait model and a policy may share a name.", "all")


@dataclass(frozen=True, kw_only=True)
class Models(Command):
    """List the shipped models with kind, method, scene, training and main result, or show the card of one of them."""

    name: Annotated[Positional[str | None], _NAME] = None

    def run(self) -> Outcome:
        from tint_sumo.methods.shipped import card_text, models_named, models_table, shipped_models

        if self.name is None:
            models = shipped_models()
            return Outcome(models_table(models), {"models": [model.summary() for model in models]})
        models = models_named(self.name)
        content = [{**model.summary(), "card": model.card} for model in models]
        return Outcome("\n\n".join(map(card_text, models)), {"models": content})
