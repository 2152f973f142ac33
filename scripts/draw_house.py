"""Draw which package imports which, from the code and its floors in pyproject.toml, into data/images/house.svg.

.venv/bin/python scripts/draw_house.py
"""

import tomllib
from itertools import count
from pathlib import Path

import grimp

ROOT = Path(__file__).resolve().parents[1]
HOUSE = ROOT / "data" / "images" / "house.svg"
PACKAGE = "tint_sumo"
ROW_PX, COLUMN_PX, LABEL_PX, HEAD_PX = 28, 28, 150, 110


def floors() -> list[list[str]]:
    """Return the packages of each floor, the top floor first."""
    with (ROOT / "pyproject.toml").open("rb") as file:
        contract = tomllib.load(file)["tool"]["importlinter"]["contracts"][0]
    return [layer.split(" | ") for layer in contract["layers"]]


def imports() -> set[tuple[str, str]]:
    """Return pairs of packages, of which the first imports the second."""
    graph = grimp.build_graph(PACKAGE)
    pairs = [(module, used) for module in graph.modules for used in graph.find_modules_directly_imported_by(module)]
    packages = {(module.split(".")[1], used.split(".")[1]) for module, used in pairs if "." in module and "." in used}
    return {(package, used) for package, used in packages if package != used}


def draw(floors: list[list[str]], imports: set[tuple[str, str]]) -> str:
    """Return an SVG with a row and a column per package, and a dot where the row's package imports the column's."""
    packages = [package for floor in floors for package in floor]
    columns = packages[1:]  # nobody imports the top floor
    width, height = LABEL_PX + COLUMN_PX * len(columns) + 60, HEAD_PX + ROW_PX * len(packages) + 8
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}"',
        ' font-family="sans-serif" font-size="14">',
        "<title>Packages of tint_sumo from the top floor to the ground, and which of them each one imports</title>",
        f'<rect width="{width}" height="{height}" fill="#ffffff"/>',
    ]
    for column, package in enumerate(columns):
        x = LABEL_PX + COLUMN_PX * column + COLUMN_PX // 2
        lines.append(f'<text transform="translate({x + 5} {HEAD_PX - 8}) rotate(-60)" fill="#1f2933">{package}</text>')
    row = count()
    for number, floor in enumerate(floors):
        fill = "#e4ecf7" if number % 2 else "#f4f7fb"
        for package in floor:
            y = HEAD_PX + ROW_PX * next(row)
            lines.append(f'<rect y="{y}" width="{width}" height="{ROW_PX}" fill="{fill}"/>')
            lines.append(f'<text x="12" y="{y + 19}" fill="#1f2933">{package}</text>')
            for column, other in enumerate(columns):
                if (package, other) in imports:
                    x = LABEL_PX + COLUMN_PX * column + COLUMN_PX // 2
                    lines.append(f'<circle cx="{x}" cy="{y + ROW_PX // 2}" r="6" fill="#2855c8"/>')
    return "\n".join([*lines, "</svg>"]) + "\n"


if __name__ == "__main__":
    HOUSE.write_text(draw(floors(), imports()), encoding="utf-8")
