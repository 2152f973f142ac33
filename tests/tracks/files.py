"""Small files of every format: a car that drives 10 m/s, half a metre to the left of a truck at 5 m/s, for 1 s."""

from collections.abc import Callable, Sequence
from pathlib import Path

from tint_sumo.core.files import write_text

FRAMES = range(11)  # at 10 Hz
CAR = ("1", 10.0, 2.0, 4.0, 1.8)  # id, speed in m/s, y of the centre in m, length, width
TRUCK = ("2", 5.0, -3.0, 12.0, 2.5)


def csv(file: Path, header: str, lines: Sequence[Sequence[object]]) -> Path:
    write_text(file, "\n".join([header, *(",".join(map(str, line)) for line in lines)]) + "\n")
    return file


def levelx(folder: Path) -> Path:
    csv(folder / "07_recordingMeta.csv", "recordingId,locationId,frameRate", [[7, 1, 10.0]])
    csv(folder / "07_tracksMeta.csv", "recordingId,trackId,class", [[7, 1, "car"], [7, 2, "truck_bus"]])
    header = "recordingId,trackId,frame,xCenter,yCenter,heading,width,length,xVelocity,yVelocity"
    lines = [
        [7, name, frame, speed * frame / 10, y, 0.0, width, length, speed, 0.0]
        for name, speed, y, length, width in (CAR, TRUCK)
        for frame in FRAMES
    ]
    return csv(folder / "07_tracks.csv", header, lines)


def highd(folder: Path) -> Path:
    csv(folder / "07_recordingMeta.csv", "id,frameRate,locationId", [[7, 10, 1]])
    csv(folder / "07_tracksMeta.csv", "id,width,height,class", [[1, 4.0, 1.8, "Car"], [2, 12.0, 2.5, "Truck"]])
    lines = [
        [frame, name, speed * frame / 10 - length / 2, -y - width / 2, length, width, speed, 0.0]
        for name, speed, y, length, width in (CAR, TRUCK)
        for frame in FRAMES
    ]
    return csv(folder / "07_tracks.csv", "frame,id,x,y,width,height,xVelocity,yVelocity", lines)


def interaction(folder: Path) -> Path:
    lines = [
        [name, frame, frame * 100, "car" if name == "1" else "truck", speed * frame / 10, y, speed, 0, 0, length, width]
        for name, speed, y, length, width in (CAR, TRUCK)
        for frame in FRAMES
    ]
    header = "track_id,frame_id,timestamp_ms,agent_type,x,y,vx,vy,psi_rad,length,width"
    return csv(folder / "vehicle_tracks_000.csv", header, lines)


def ngsim(folder: Path) -> Path:
    foot = 0.3048
    lines = [
        [
            *(name, frame, len(FRAMES), 1_118_846_980_200 + 100 * frame),
            *((speed * frame / 10 + length / 2) / foot, y / foot, length / foot, width / foot),
            *(2 if name == "1" else 3, speed / foot),
        ]
        for name, speed, y, length, width in (CAR, TRUCK)
        for frame in FRAMES
    ]
    header = "Vehicle_ID,Frame_ID,Total_Frames,Global_Time,Local_X,Local_Y,v_Length,v_Width,v_Class,v_Vel"
    return csv(folder / "trajectories.csv", header, lines)


def tgsim(folder: Path) -> Path:
    lines = [
        [name, frame / 10, 1, speed * frame / 10, -y, speed, length, width, 1 if name == "1" else 2]
        for name, speed, y, length, width in (CAR, TRUCK)
        for frame in FRAMES
    ]
    header = "id,time,run-index,xloc-kf,yloc-kf,speed-kf,length-smoothed,width-smoothed,type-most-common"
    return csv(folder / "run.csv", header, lines)


def commonroad(folder: Path) -> Path:
    def state(tag: str, frame: int, speed: float, y: float) -> str:
        x = speed * frame / 10
        return (
            f"<{tag}><position><point><x>{x}</x><y>{y}</y></point></position>"
            f"<orientation><exact>0.0</exact></orientation><time><exact>{frame}</exact></time>"
            f"<velocity><intervalStart>{speed - 1}</intervalStart><intervalEnd>{speed + 1}</intervalEnd></velocity>"
            f"</{tag}>"
        )

    def obstacle(name: str, speed: float, y: float, length: float, width: float) -> str:
        states = "".join(state("state", frame, speed, y) for frame in FRAMES[1:])
        return (
            f'<dynamicObstacle id="{name}"><type>{"car" if name == "1" else "truck"}</type><shape><rectangle>'
            f"<length>{length}</length><width>{width}</width></rectangle></shape>"
            f"{state('initialState', 0, speed, y)}<trajectory>{states}</trajectory></dynamicObstacle>"
        )

    text = f'<?xml version="1.0"?><commonRoad timeStepSize="0.1">{obstacle(*CAR)}{obstacle(*TRUCK)}</commonRoad>'
    write_text(folder / "USA_Test-1_1_T-1.xml", text)
    return folder / "USA_Test-1_1_T-1.xml"


FILES: dict[str, Callable[[Path], Path]] = {
    one.__name__: one for one in (levelx, highd, interaction, ngsim, tgsim, commonroad)
}
