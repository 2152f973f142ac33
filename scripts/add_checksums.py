"""Write checksums of weights into the cards beside them; of shipped models, or of files that are given.

    .venv/bin/python scripts/add_checksums.py [FILE.safetensors ...]

Training writes them; this is for models of versions that did not.
"""

import sys
from pathlib import Path

from tint_sumo.core.files import shipped
from tint_sumo.core.weights import add_checksum

if __name__ == "__main__":
    for file in map(Path, sys.argv[1:]) if sys.argv[1:] else sorted(shipped("models").rglob("*.safetensors")):
        add_checksum(file)
        print(file)
