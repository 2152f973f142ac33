"""SUMO configurations in all the forms that SUMO reads."""

import gzip
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.scenes.networks import UserNetwork, write_config
from tint_sumo.config import MOST_LABELS
from tint_sumo.core.errors import InputError
from tint_sumo.scenes.sumo_config import base_vtype, read_config, read_vtypes
from tint_sumo.scenes.sumo_run import require_loads

Make = Callable[[str], UserNetwork]
ROUTES = '<routes>{}<vehicle id="one" depart="0" type="car"><route edges="in out"/></vehicle></routes>'


@pytest.fixture
def folder(user_network: Make, tmp_path: Path) -> Path:
    """A folder with the configuration ``merge.sumocfg`` and its files, which may be changed."""
    return Path(shutil.copytree(user_network("merge").sumocfg.parent, tmp_path / "merge"))


def with_routes(folder: Path, routes: str, more: str = "") -> Path:
    """Write a configuration with other demand."""
    (folder / "other.rou.xml").write_text(routes)
    return write_config(folder / "other.sumocfg", "merge.net.xml", "other.rou.xml", more)


def test_too_many_vtypes_are_refused(folder: Path) -> None:
    lines = "".join(f'<vType id="{number}"/>' for number in range(MOST_LABELS + 1))
    (folder / "merge.rou.xml").write_text(f"<routes>{lines}</routes>")
    with pytest.raises(InputError, match="32,768 vTypes; at most 32,767"):
        read_vtypes(read_config(folder / "merge.sumocfg"))


def test_configurations_are_read_in_all_their_forms(folder: Path) -> None:
    short = folder / "short.sumocfg"
    short.write_text(
        '<configuration><n v="merge.net.xml"/><r v="merge.rou.xml"/><step-length v="0:0:0.5"/></configuration>'
    )
    found = read_config(short)
    assert found.files == (short, folder / "merge.net.xml", folder / "merge.rou.xml")
    assert found.step_s == 0.5
    output = write_config(folder / "o.sumocfg", "merge.net.xml", "merge.rou.xml", '<tripinfo-output value="t.xml"/>')
    assert "tripinfo-output" not in dict(read_config(output).options)
    with pytest.raises(InputError, match="names no net-file"):
        read_config(write_config(folder / "x.sumocfg", "", "merge.rou.xml"))
    with pytest.raises(InputError, match="step-length 'soon'"):
        read_config(write_config(folder / "x.sumocfg", "merge.net.xml", "", '<step-length value="soon"/>'))


@pytest.mark.parametrize("name", ["spaces and ünicode", "a comma, and; more", "per%20cent $x"])
def test_folders_may_have_any_name(name: str, folder: Path) -> None:
    other = Path(shutil.copytree(folder, folder.parent / name))
    config = read_config(other / "merge.sumocfg")
    assert config.files == (other / "merge.sumocfg", other / "merge.net.xml", other / "merge.rou.xml")
    assert config.digest == read_config(folder / "merge.sumocfg").digest
    scratch = folder / "scratch"
    scratch.mkdir()
    net_file = config.values(scratch)["net-file"]
    assert "," not in net_file
    assert Path(net_file).samefile(other / "merge.net.xml")


@pytest.mark.parametrize("second", [" b.add.xml", "\n        b.add.xml ", " ../merge/b.add.xml", " {folder}/b.add.xml"])
def test_blanks_and_line_breaks_may_part_the_files_of_a_list(second: str, folder: Path) -> None:
    for name in ("a", "b"):
        (folder / f"{name}.add.xml").write_text(f'<additional><vType id="{name}"/></additional>')
    more = f'<additional-files value=" a.add.xml ,{second.format(folder=folder)}"/>'
    config = read_config(write_config(folder / "l.sumocfg", " merge.net.xml ", "merge.rou.xml", more))
    assert [file.name for file in config.files] == [
        "l.sumocfg",
        "merge.net.xml",
        "a.add.xml",
        "b.add.xml",
        "merge.rou.xml",
    ]
    assert read_vtypes(config) == ("a", "b", "calm", "hasty")
    require_loads(config)


def test_paths_begin_where_a_link_to_the_configuration_is(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "elsewhere.sumocfg").write_bytes((folder / "merge.sumocfg").read_bytes())
    link = folder / "link.sumocfg"
    link.symlink_to(tmp_path / "elsewhere.sumocfg")
    assert read_config(link).net_file == folder / "merge.net.xml"


def test_a_link_to_itself_is_refused(tmp_path: Path) -> None:
    (tmp_path / "loop.sumocfg").symlink_to(tmp_path / "loop.sumocfg")
    with pytest.raises(InputError, match=r"loop\.sumocfg"):
        read_config(tmp_path / "loop.sumocfg")


def test_environment_variables_are_put_in(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config = write_config(folder / "v.sumocfg", "${NETS}/merge.net.xml", "merge${KIND}.xml")
    with pytest.raises(InputError, match=r"names net-file \$\{NETS\}/merge\.net\.xml"):
        read_config(config)
    monkeypatch.setenv("NETS", str(folder))
    monkeypatch.setenv("KIND", ".rou")
    assert read_config(config).files[1:] == (folder / "merge.net.xml", folder / "merge.rou.xml")


def test_files_may_include_others(folder: Path) -> None:
    (folder / "sub").mkdir()
    (folder / "sub" / "types.xml").write_text('<additional><vType id="car"/></additional>')
    (folder / "sub" / "more.xml").write_text('<additional><include href="types.xml"/></additional>')
    config = read_config(with_routes(folder, ROUTES.format('<include href="sub/more.xml"/>')))
    assert [file.name for file in config.demand_files] == ["other.rou.xml", "more.xml", "types.xml"]
    assert read_vtypes(config) == ("car",)
    before = config.digest
    (folder / "sub" / "types.xml").write_text('<additional><vType id="car" tau="2"/></additional>')
    assert config.digest != before
    (folder / "sub" / "types.xml").unlink()
    with pytest.raises(InputError, match=r"more\.xml includes .*types\.xml, and there is no such file"):
        read_config(config.file)


def test_files_that_include_each_other_end(folder: Path) -> None:
    (folder / "b.xml").write_text('<routes><include href="other.rou.xml"/></routes>')
    config = read_config(with_routes(folder, ROUTES.format('<vType id="car"/><include href="./b.xml"/>')))
    assert [file.name for file in config.demand_files] == ["other.rou.xml", "b.xml"]


def test_gzipped_demand_is_read(folder: Path) -> None:
    (folder / "r.rou.xml.gz").write_bytes(gzip.compress((folder / "merge.rou.xml").read_bytes()))
    config = read_config(write_config(folder / "gz.sumocfg", "merge.net.xml", "r.rou.xml.gz"))
    assert read_vtypes(config) == ("calm", "hasty")


def test_options_about_output_messages_and_windows_are_left_out(folder: Path) -> None:
    more = """
        <help value="true"/><version value="true"/><print-options value="true"/>
        <save-template value="t.xml"/><save-schema value="s.xsd"/><save-configuration value="c.cfg"/>
        <tripinfo value="trips.xml"/><ndump value="n.xml"/><log-file value="l.txt"/><save-state.period value="5"/>
        <remote-port value="8873"/><num-clients value="3"/><start value="true"/><gui-settings-file value="none.xml"/>
        <xml-validation.routes value="never"/><scale value="2"/><time-to-teleport value="5"/>
    """
    before = set(folder.iterdir())
    config = read_config(write_config(folder / "o.sumocfg", "merge.net.xml", "merge.rou.xml", more))
    assert set(folder.iterdir()) - before == {folder / "o.sumocfg"}
    assert [name for name, _ in config.options] == [
        *("net-file", "route-files", "scale", "time-to-teleport", "xml-validation.routes")
    ]
    assert {"tripinfo-output", "netstate-dump", "log", "remote-port", "start"} <= set(config.left_out)


@pytest.mark.parametrize(
    ("option", "message"),
    [
        ("mesosim", r"is mesoscopic, .*; leave mesosim out"),
        ("no-internal-links", r"lets vehicles jump over junctions, .*; leave no-internal-links out"),
    ],
)
def test_configurations_in_which_drivers_have_no_positions_everywhere_are_refused(
    option: str, message: str, folder: Path
) -> None:
    def config(value: str) -> Path:
        return write_config(folder / "m.sumocfg", "merge.net.xml", "merge.rou.xml", f'<{option} value="{value}"/>')

    for on in ("1", "true", "Yes"):
        with pytest.raises(InputError, match=message):
            read_config(config(on))
    for off in ("0", "False", "off"):
        assert dict(read_config(config(off)).options)[option] == off


def test_what_sumo_says_of_a_configuration_that_it_refuses_is_one_line(folder: Path) -> None:
    config = write_config(folder / "w.sumocfg", "merge.net.xml", "merge.rou.xml", '<no-such-option value="1"/>')
    with pytest.raises(InputError, match=r"SUMO does not read .*w\.sumocfg \(.*no-such-option") as caught:
        read_config(config)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("demand", "vtypes"),
    [
        ('<person id="p" depart="0"><personTrip from="in" to="out" modes="car"/></person>', ("DEFAULT_VEHTYPE",)),
        (
            '<personFlow id="p" begin="0" period="3"><personTrip from="in" to="out" modes="bicycle"/></personFlow>',
            ("DEFAULT_BIKETYPE",),
        ),
        (
            '<vType id="van"/><person id="p"><personTrip from="in" to="out" modes="car" vTypes="van"/></person>',
            ("van",),
        ),
        ('<person id="p" depart="0"><walk from="in" to="out"/></person>', ()),
    ],
)
def test_vehicles_that_sumo_makes_for_persons_have_labels(demand: str, vtypes: tuple[str, ...], folder: Path) -> None:
    assert read_vtypes(read_config(with_routes(folder, f"<routes>{demand}</routes>"))) == vtypes


def test_a_vtype_that_sumo_makes_for_one_vehicle_has_the_label_of_its_base() -> None:
    assert base_vtype("car@flow.3", ("car", "van")) == "car"
    assert base_vtype("odd@name", ("odd@name",)) == "odd@name"
    assert base_vtype("odd@name@flow.3", ("odd@name",)) == "odd@name"
    assert base_vtype("other@x", ("car",)) == "other@x"


def test_a_relative_path_is_that_of_the_folder_of_work(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    config = read_config(Path("merge.sumocfg"))
    monkeypatch.chdir(os.sep)
    assert config.net_file.is_file()
