"""Films and film strips of single cases."""

import subprocess
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image, ImageColor

from tint_sumo.core.errors import InputError
from tint_sumo.core.files import require_output_file, whole_file
from tint_sumo.core.progress import Progress, Report, silent
from tint_sumo.core.sampling import evenly_spread
from tint_sumo.envs import TaskSettings
from tint_sumo.envs.rendering import RENDER_FPS
from tint_sumo.films.driving import Driven, Moment, drive_case
from tint_sumo.films.frames import SIZE_PX, Artist
from tint_sumo.films.network_frames import NetworkArtist, vtypes_in
from tint_sumo.films.trait_probe import fit_reader
from tint_sumo.methods.evaluation import CASE_SETS, CASES_PER_SET
from tint_sumo.methods.loading import Contender
from tint_sumo.methods.registry import look_of
from tint_sumo.scenes import AnyScene, Scene, SumocfgScene
from tint_sumo.scenes.drivers import require_two_kinds
from tint_sumo.scenes.layout import layout

SUFFIXES = (".mp4", ".gif", ".png")
_STRIP, _GAP_PX = (4, 2), 4  # pictures across and down, and what is between them
_SPACE = " " * 5  # between the parts of a title
_LAST_S = 1.5  # a film shows its last moment for so long


_Artist = Artist | NetworkArtist


@dataclass(frozen=True)
class Film:
    """The outcome of the case, and the size of the film."""

    outcome: str
    time_s: float
    frames: int


def render_case(
    contender: Contender,
    case: int,
    out: Path,
    *,
    case_set: int = 0,
    task: TaskSettings | None = None,
    report: Report = silent,
) -> Film:
    """Drive one unseen case and write what happened: a film, or for .png a strip of its moments.

    A film runs in real time. It shows every step of the simulation; of steps shorter than 0.1 s, those 0.1 s apart.

    Args:
        contender: who drives.
        case: number of the case, as in ``tint_sumo.methods.evaluation.evaluate``.
        out: .mp4, .gif or .png file.
        case_set: number of the case set, 0 to 1000.
        task: settings of the environment; those of the contender if not given.
        report: called with the progress.

    Raises:
        InputError: there is no such case, or no such kind of film, or what writes it is not installed.
    """
    require_film_file(out)
    CASE_SETS.require("case_set", case_set)
    if not 0 <= case < CASES_PER_SET:
        raise InputError(f"case must lie in 0 to {CASES_PER_SET - 1}, not {case}")
    task = task or contender.task
    require_film_scene(task.played)
    driven = drive_case(contender, case, case_set, task)
    step_s = task.played.step_s
    every = max(round(1.0 / (RENDER_FPS * step_s)), 1)  # steps between two frames
    shown = _spread(driven.moments) if out.suffix.lower() == ".png" else driven.moments[::-every][::-1]
    artist = _artist(contender, task, driven, f"case {case} of set {case_set}")
    with whole_file(out) as partial:
        _WRITERS[out.suffix.lower()](partial, artist, shown, 1.0 / (every * step_s), report)
    return Film(driven.case.outcome, driven.case.time_s, len(shown))


def _artist(contender: Contender, task: TaskSettings, driven: Driven, case: str) -> _Artist:
    """Return what draws the moments of a case."""
    scene = task.played
    parts = [Path(contender.name).name, scene.name, case]
    colour = ImageColor.getrgb(look_of(contender.method).colour)
    if isinstance(scene, SumocfgScene):
        title = _SPACE.join(parts)
        return NetworkArtist(
            scene, title, colour, vtypes_in(driven.moments), driven.origin_m, task.sensor, driven.buildings
        )
    assert task.p_conservative is not None
    title = _SPACE.join([*parts, f"P(conservative) {task.p_conservative.text}"])
    has_attention = driven.moments[0].attention is not None
    return Artist(layout(scene), title, colour, fit_reader(contender), has_attention, task.sensor)


def require_film_scene(scene: AnyScene) -> None:
    """Raise InputError unless a film can show a scene."""
    if isinstance(scene, Scene):
        require_two_kinds(len(scene.traits), "a film", f"scene {scene.name}")


def require_film_file(out: Path) -> None:
    """Raise InputError unless a film can be written there."""
    require_output_file(out, SUFFIXES)
    if out.suffix.lower() == ".mp4":
        try:
            import imageio_ffmpeg  # noqa: F401, PLC0415 - of an extra
        except ImportError:
            raise InputError('.mp4 needs: pip install "tint_sumo[video]"; .gif and .png do without') from None


def _spread(moments: Sequence[Moment]) -> list[Moment]:
    """Return at most as many moments as a strip shows, evenly spread, the first and the last among them."""
    across, down = _STRIP
    return [moments[index] for index in evenly_spread(len(moments), across * down).tolist()]


def _frames(artist: _Artist, moments: Sequence[Moment], report: Report) -> Iterator[Image.Image]:
    for done, moment in enumerate(moments, start=1):
        yield artist.frame(moment)
        report(Progress(done, len(moments), "frame"))


def _write_strip(
    file: Path,
    artist: _Artist,
    moments: Sequence[Moment],
    fps: float,  # noqa: ARG001 - a strip does not move
    report: Report,
) -> None:
    pitch_px = [side + _GAP_PX for side in SIZE_PX]
    size = [count * pitch - _GAP_PX for count, pitch in zip(_STRIP, pitch_px, strict=True)]
    strip = Image.new("RGB", (size[0], size[1]))
    for number, frame in enumerate(_frames(artist, moments, report)):
        down, across = divmod(number, _STRIP[0])
        strip.paste(frame, (across * pitch_px[0], down * pitch_px[1]))
    strip.save(file, format="PNG")


def _write_gif(file: Path, artist: _Artist, moments: Sequence[Moment], fps: float, report: Report) -> None:
    palette = _palette(artist, moments)
    first, *rest = (
        frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in _frames(artist, moments, report)
    )
    durations_ms = [round(1000 / fps)] * len(rest) + [round(1000 * _LAST_S)]
    first.save(file, format="GIF", save_all=True, append_images=rest, duration=durations_ms, loop=0)


def _palette(artist: _Artist, moments: Sequence[Moment]) -> Image.Image:
    """Return the colours of the first, a middle and the last moment."""
    chosen = (moments[0], moments[len(moments) // 2], moments[-1])
    return Image.fromarray(np.concatenate([np.asarray(artist.frame(moment)) for moment in chosen])).quantize()


def _write_mp4(file: Path, artist: _Artist, moments: Sequence[Moment], fps: float, report: Report) -> None:
    import imageio_ffmpeg  # noqa: PLC0415 - of an extra

    width, height = SIZE_PX
    command = [
        imageio_ffmpeg.get_ffmpeg_exe(),
        *("-y", "-v", "error"),
        *("-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", str(fps), "-i", "-"),
        *("-vcodec", "libx264", "-pix_fmt", "yuv420p", "-crf", "25", "-f", "mp4", str(file)),
    ]
    pixels = b""
    with subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdin is not None
        with suppress(BrokenPipeError):  # it has ended, and says why
            for frame in _frames(artist, moments, report):
                pixels = frame.tobytes()
                process.stdin.write(pixels)
            process.stdin.write(pixels * round(_LAST_S * fps))
        _, printed = process.communicate()
    if process.returncode != 0:  # imageio_ffmpeg's own writer would leave half a film in silence
        raise OSError(f"ffmpeg failed on {file.parent}: {' '.join(printed.decode(errors='replace').split())}")


_WRITERS = {".mp4": _write_mp4, ".gif": _write_gif, ".png": _write_strip}
