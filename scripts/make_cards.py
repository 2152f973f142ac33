"""Write the model cards (.md, in the form of Hugging Face) of all shipped models from the .json files beside them.

.venv/bin/python scripts/make_cards.py
"""

from tint_sumo.core.files import write_text
from tint_sumo.methods.shipped import shipped_models

for model in shipped_models():
    write_text(model.page_file, model.page())
