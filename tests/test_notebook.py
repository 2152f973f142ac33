"""The example notebooks run from their first cell to their last."""

import re
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

EXAMPLES = Path(__file__).parents[1] / "examples"
FILM = EXAMPLES / "from_dataset_to_video.ipynb"
COURSE = EXAMPLES / "course.ipynb"


def run(file: Path, folder: Path) -> nbformat.NotebookNode:
    """Return the notebook with its outputs, run in a folder."""
    notebook = nbformat.read(file, as_version=4)
    resources = {"metadata": {"path": str(folder)}}
    NotebookClient(notebook, timeout=300, kernel_name="python3", resources=resources).execute()
    return notebook


def pictures(notebook: nbformat.NotebookNode) -> list[str]:
    outputs = [output.get("data", {}) for cell in notebook.cells for output in cell.get("outputs", [])]
    return [kind for output in outputs for kind in output if kind.startswith("image/")]


def printed(cell: nbformat.NotebookNode) -> str:
    return "".join(output["text"] for output in cell.outputs if output["output_type"] == "stream")


@pytest.mark.parametrize("file", [FILM, COURSE], ids=lambda file: file.stem)
def test_a_notebook_is_kept_without_outputs(file: Path) -> None:
    code = [cell for cell in nbformat.read(file, as_version=4).cells if cell.cell_type == "code"]
    assert code
    assert all(cell.outputs == [] and cell.execution_count is None for cell in code)


def test_each_exercise_of_the_course_has_a_folded_solution_and_answer() -> None:
    cells = nbformat.read(COURSE, as_version=4).cells
    exercises = [number for number, cell in enumerate(cells) if "exercise" in cell.metadata.get("tags", [])]
    assert len(exercises) == 5
    for number in exercises:
        task, _, solution, answer = cells[number - 1 : number + 3]
        assert task.source.startswith("### Exercise")
        assert solution.metadata.tags == ["solution"]
        assert solution.metadata.jupyter == {"source_hidden": True, "outputs_hidden": True}
        assert answer.source.startswith("<details><summary>Answer</summary>")


@pytest.mark.long
def test_the_notebook_from_a_dataset_to_a_film_runs(tmp_path: Path) -> None:
    shown = pictures(run(FILM, tmp_path))
    assert {"image/png", "image/gif"} <= set(shown)
    made = tmp_path / "runs" / "notebook"
    assert (made / "policy" / "policy.safetensors").exists()
    assert (made / "film.gif").read_bytes().startswith(b"GIF")


@pytest.mark.long
def test_the_course_runs_and_its_solutions_are_what_its_answers_say(tmp_path: Path) -> None:
    notebook = run(COURSE, tmp_path)
    assert pictures(notebook) == ["image/png"] * 6
    one, two, three, four, five = (
        printed(cell) for cell in notebook.cells if "solution" in cell.metadata.get("tags", [])
    )
    speed, gap, time_gap = (float(share) for share in re.findall(r"([\d.]+)%", one))
    assert speed < gap < time_gap and time_gap > 99.0
    assert all(0.0 < float(wrong) < 5.0 for wrong in re.findall(r"wrong about ([\d.]+)%", two))
    without, careful, patient, unknown = re.findall(r"'success': (\d+), 'timeout': \d+, 'collision': (\d+)", three)
    assert without[1] != "0" and careful[1] == "0" and int(careful[0]) > 20
    assert int(patient[0]) < int(careful[0]) and unknown[1] != "0"
    home, headway, towns = (float(share) for share in re.findall(r"([\d.]+)%", four))
    assert home > 95.0 and headway > 95.0 and 75.0 < towns < 90.0
    collisions = [int(number) for number in re.findall(r"'collision': (\d+)", five)]
    assert collisions[::2] == [0, 0] and min(collisions[1::2]) > 5
