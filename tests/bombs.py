"""Files that run code when they are unpickled: here, they make a folder."""

import base64
import io
import json
import os
import pickle
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import torch


class Bomb:
    """Unpickled, it makes the folder ``marker``."""

    def __init__(self, marker: Path) -> None:
        self.marker = marker

    def __reduce__(self) -> Any:
        return os.mkdir, (str(self.marker),)


def bomb(kind: str, marker: Path) -> bytes:
    """A bomb as a reader of ``kind`` would take it."""
    file = io.BytesIO()
    if kind == "pickle":
        return pickle.dumps(Bomb(marker))
    if kind == "torch":
        torch.save({"weight": Bomb(marker)}, file)
    elif kind == "old torch":
        torch.save({"weight": Bomb(marker)}, file, _use_new_zipfile_serialization=False)
    elif kind == "numpy":
        np.save(file, np.array([Bomb(marker)], object), allow_pickle=True)
    else:
        assert kind == "stable-baselines3"
        serialized = base64.b64encode(pickle.dumps(Bomb(marker))).decode()
        with zipfile.ZipFile(file, "w") as archive:
            archive.writestr("data", json.dumps({"policy_kwargs": {":type:": "dict", ":serialized:": serialized}}))
    return file.getvalue()


BOMBS = ("pickle", "torch", "old torch", "numpy", "stable-baselines3")
