"""``tint-sumo models``."""

from dataclasses import dataclass

from tyro.conf import Positional

from tint_sumo.cli.command import Command, Outcome


@dataclass(frozen=True, kw_only=True)
class Models(Command):
    """List the trained models that are shipped: kind, method, scene, training and main result; or show one's card."""

    name: Positional[str | None] = None
    """Name of a shipped model, whose card is shown; a trait model and a policy may share it."""

    def run(self) -> Outcome:
        from tint_sumo.methods.shipped import card_text, models_named, models_table, shipped_models

        if self.name is None:
            models = shipped_models()
            return Outcome(models_table(models), {"models": [model.summary() for model in models]})
        models = models_named(self.name)
        content = [{**model.summary(), "card": model.card} for model in models]
        return Outcome("\n\n".join(map(card_text, models)), {"models": content})
