"""URDFs and meshes of strangers: robots with finite numbers or one line, soon, and no look beyond their package."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import pytest
from hostile import examined
from hostile_robots import OUTSIDE, WHOLE, damaged, damaged_meshes, meshes, tree, urdfs

from torchid.errors import TorchidWarning, UrdfError
from torchid.guards import MAX_LINKS, MAX_NUMBER
from torchid.robot import Robot, body_extents, load_robot


@pytest.fixture(autouse=True, scope="module")
def _readers_loaded(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Trimesh loads its readers when they are first used, which is not what is measured."""
    folder = tmp_path_factory.mktemp("whole")
    for suffix, content in WHOLE.items():
        (folder / f"mesh.{suffix}").write_bytes(content)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", TorchidWarning)
        for _, path in damaged_meshes(folder, len(WHOLE), 0):
            seen(path)


def robot(path: Path) -> Robot:
    """Load a robot, all of whose numbers must be finite."""
    loaded = load_robot(path)
    places = [T for _, T in loaded.links.values()]
    for numbers in (loaded.nominal, *loaded.joint_map, *places):
        assert np.isfinite(numbers).all()
    return loaded


def seen(path: Path) -> None:
    """Look at the shapes of a robot's bodies, which must be finite."""
    for extent in body_extents(load_robot(path)).values():
        for numbers in vars(extent).values():
            assert np.isfinite(numbers).all()


@pytest.mark.slow("all files made to harm")
def test_urdfs_made_to_harm_or_damaged_give_a_robot_or_one_line(tmp_path: Path) -> None:
    tally = examined("URDFs", urdfs(tmp_path), robot, tmp_path)
    assert tally.faults == []
    assert tally.share("refused") > 0.5
    tally = examined("damaged URDFs", damaged(tmp_path, 60, seed=6), robot, tmp_path)
    assert tally.faults == []
    assert tally.share("refused") > 0.9


@pytest.mark.slow("all files made to harm")
def test_hostile_and_damaged_meshes_are_read_or_left_out(tmp_path: Path) -> None:
    """A mesh that cannot be read costs its body the extent, with a warning; the judge looks at that too."""
    tally = examined("meshes", meshes(tmp_path), seen, tmp_path)
    assert tally.faults == []
    assert tally.share("accepted") > 0.9
    tally = examined("damaged meshes", damaged_meshes(tmp_path, 20, seed=7), seen, tmp_path)
    assert tally.faults == []
    assert tally.share("accepted") == 1.0


def test_no_mesh_outside_the_package_is_opened(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    opened: list[Path] = []
    plain = Path.read_bytes
    monkeypatch.setattr(Path, "read_bytes", lambda path: opened.append(path) or plain(path))
    for name, path in meshes(tmp_path):
        if name.removeprefix("at ") not in OUTSIDE:
            continue
        opened.clear()
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            assert body_extents(load_robot(path)) == {}
        assert any("unreadable mesh" in str(warning.message) for warning in caught)
        assert opened == []


@pytest.mark.parametrize(
    ("stored", "named"),
    [
        ("one/meshes/a.obj", "package://one/meshes/a.obj"),
        ("two/meshes/a.obj", "package://two/meshes/a.obj"),
        ("one/deep/urdf/robots/a.obj", "a.obj"),
        ("one/meshes/a.obj", "../../../meshes/a.obj"),
    ],
)
def test_a_package_reaches_as_far_as_its_mark(tmp_path: Path, stored: str, named: str) -> None:
    """However deep the URDF stands in it, and into the packages beside it."""
    folder = tmp_path / "one" / "deep" / "urdf" / "robots"
    for made in (folder, (tmp_path / stored).parent):
        made.mkdir(parents=True, exist_ok=True)
    (tmp_path / "one" / "package.xml").write_text("<package/>")
    (tmp_path / stored).write_bytes(WHOLE["obj"])
    shape = f'<visual><geometry><mesh filename="{named}"/></geometry></visual>'
    (folder / "m.urdf").write_text(tree(1, True).replace("</link>", f"{shape}</link>"))
    assert list(body_extents(load_robot(folder / "m.urdf"))) == [0]


def test_a_binary_stl_says_the_same_to_us_as_to_trimesh(tmp_path: Path) -> None:
    import trimesh

    box = trimesh.creation.box((1.0, 2.0, 3.0), trimesh.transformations.translation_matrix((4.0, 5.0, 6.0)))
    (tmp_path / "box.stl").write_bytes(box.export(file_type="stl"))
    shape = '<visual><geometry><mesh filename="box.stl" scale="2 2 2"/></geometry></visual>'
    (tmp_path / "m.urdf").write_text(tree(1, True).replace("</link>", f"{shape}</link>"))
    extent = body_extents(load_robot(tmp_path / "m.urdf"))[0]
    np.testing.assert_allclose(extent.centre, [8.0, 10.0, 12.0])
    np.testing.assert_allclose(extent.half, [1.0, 2.0, 3.0])


@pytest.mark.parametrize("chain", [True, False])
def test_the_largest_robot_is_built_and_a_larger_one_refused(tmp_path: Path, chain: bool) -> None:
    path = tmp_path / "m.urdf"
    path.write_text(tree(MAX_LINKS, chain))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", TorchidWarning)
        assert load_robot(path).n == MAX_LINKS - 1
    path.write_text(tree(MAX_LINKS + 1, chain))
    with pytest.raises(UrdfError, match=f"link: {MAX_LINKS + 1} links; accepted: at most {MAX_LINKS}"):
        load_robot(path)


@pytest.mark.parametrize("number", ["1_0", "１", "1e400", "0x1", f"{10.0 * MAX_NUMBER:g}"])
def test_what_python_takes_for_a_number_is_not_always_one(tmp_path: Path, number: str) -> None:
    path = tmp_path / "m.urdf"
    path.write_text(tree(2, True).replace('mass value="1"', f'mass value="{number}"'))
    with pytest.raises(UrdfError, match=r"link 'l0', <(mass value|inertial)>: .*; accepted: .*number"):
        load_robot(path)
