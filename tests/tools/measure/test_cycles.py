"""The pure parts of the Cycles card: what is planned, how lenses are told to Blender, how findings become figures."""

import math
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from flockd.core.messages import VehicleState
from flockd.flight.geometry import WideAngleCamera, build_rig
from tools.measure import cycles_card
from tools.measure.cycles.airframes import airframe
from tools.measure.cycles.card import Findings, Sight, iou_of, rows
from tools.measure.cycles.jobs import PROPELLER, Job, airframe_file, read_job, write_job
from tools.measure.cycles.lens import SENSOR_MM, Lens, blender_camera, known_places, theta_polynomial
from tools.measure.cycles.plan import CLEAR_M, RANGES_M, ground_height, moment, rotation
from tools.measure.cycles.sources import AIRFRAMES, Source
from tools.measure.cycles.taken import draw_taken, known_models, real_models

NAMES = tuple(AIRFRAMES)
MOMENTS = [moment(7, number, NAMES) for number in range(40)]


def test_a_moment_comes_from_its_seed_alone() -> None:
    assert moment(7, 3, NAMES) == MOMENTS[3]
    assert moment(8, 3, NAMES) != MOMENTS[3]


def test_drones_of_a_moment_are_clear_of_each_other_of_the_ground_and_of_trees() -> None:
    for one in MOMENTS:
        assert 1 <= len(one.neighbours) <= 5
        ways = [one.own, *(neighbour.poses for neighbour in one.neighbours)]
        for k in range(2):
            places = np.array([way[k].position for way in ways])
            apart = np.linalg.norm(places[:, None] - places[None], axis=2)
            assert apart[~np.eye(len(ways), dtype=bool)].min() > 1.0
            assert (-places[:, 2] - ground_height(one.relief, places[:, 0], places[:, 1])).min() > 1.0
            for thing in one.standing:
                assert np.linalg.norm(places[:, :2] - thing.north_east, axis=1).min() > CLEAR_M
        ranges = [math.dist(one.own[0].position, neighbour.poses[0].position) for neighbour in one.neighbours]
        assert RANGES_M[0] * 0.99 < min(ranges)
        assert max(ranges) < RANGES_M[1] * 1.01


def test_a_job_is_read_as_it_was_written(tmp_path: Path) -> None:
    rigs = {name: cycles_card.lenses_of(config) for name, config in cycles_card.drones("none").items()}
    job = Job(tuple(MOMENTS[:3]), rigs, "meshes", 16, 1)
    write_job(job, tmp_path / "job.json")
    assert read_job(tmp_path / "job.json") == job


def test_the_real_drones_cameras_look_forward_right_back_and_left() -> None:
    lenses = cycles_card.lenses_of(cycles_card.drones("none")["fisheye"])
    assert [lens.model for lens in lenses] == ["wide_angle"] * 4
    axes = [np.round(np.array(lens.R_body_camera)[:, 2], 9).tolist() for lens in lenses]
    assert axes == [[1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]]


@pytest.mark.parametrize("detector", ["none", "detector"])
def test_both_rigs_are_measured_with_the_detector_that_is_asked_for(detector: str) -> None:
    assert [one.perception.detector for one in cycles_card.drones(detector).values()] == [detector] * 2


def test_a_pinhole_is_told_by_its_focal_length_in_millimetres() -> None:
    told = blender_camera(cycles_card.lenses_of(cycles_card.drones("none")["pinhole"])[0])
    # Blender: the angle across the sensor's width is 2 atan(width / 2 f).
    assert 2 * math.atan(told["sensor_width"] / 2 / told["lens"]) == pytest.approx(2 * math.atan(240 / 222))
    assert (told["shift_x"], told["shift_y"]) == (0, 0)


def test_an_equidistant_lens_has_one_coefficient() -> None:
    focal_mm = 305.6 * SENSOR_MM / 640
    assert theta_polynomial(focal_mm, (), 22.5) == pytest.approx((0, 1 / focal_mm, 0, 0, 0), abs=1e-9)


def test_the_polynomial_leads_back_to_the_angle_of_flockds_lens() -> None:
    distortion = (0.02, -0.011, 0.003, -0.0004)
    camera = WideAngleCamera(np.array([[305.6, 0, 320], [0, 305.6, 240], [0, 0, 1]]), (640, 480), distortion)
    angles = np.linspace(0.05, 1.25, 30)
    pixels = camera.project(np.stack([np.sin(angles), np.zeros(30), np.cos(angles)], axis=1))
    radius_mm = (pixels[:, 0] - 320) * SENSOR_MM / 640
    k = theta_polynomial(305.6 * SENSOR_MM / 640, distortion, 22.5)
    found = sum(k[power] * radius_mm**power for power in range(5))
    assert np.abs(found - angles).max() * 305.6 < 0.1


@pytest.mark.parametrize(
    ("changed", "says"),
    [
        ({"model": "pinhole", "distortion": (0.1, 0.0, 0.0, 0.0)}, "pinhole has no distortion"),
        ({"cx": 300.0}, "middle of its image"),
        ({"fy": 300.0}, "square"),
    ],
)
def test_a_lens_that_blender_has_not_is_refused(changed: dict[str, object], says: str) -> None:
    lens = cycles_card.lenses_of(cycles_card.drones("none")["fisheye"])[0]
    with pytest.raises(ValueError, match=says):
        blender_camera(Lens(**{**vars(lens), **changed}))


def test_known_places_are_in_the_image() -> None:
    for config in cycles_card.drones("none").values():
        camera = next(iter(build_rig(config.rig).cameras.values())).camera
        pixels = camera.project(known_places(cycles_card.lenses_of(config)[0]))
        assert camera.in_image(pixels).all()
        # As far out as the spiral says: 0.46 of the narrower side, but for half a turn's share.
        out = np.linalg.norm(pixels - np.array(camera.size) / 2, axis=1).max()
        assert out == pytest.approx(0.46 * min(camera.size), rel=0.02)


def test_what_propellers_blur_counts_for_no_mask() -> None:
    ids = np.zeros((20, 20), np.uint8)
    ids[5:10, 5:15] = 1
    ids[4, 5:15] = PROPELLER + 1
    said = np.zeros((20, 20), bool)
    said[4:10, 5:10] = True  # half of the body, and half of the disc
    assert iou_of(said, ids, 1) == pytest.approx(0.5)
    said[12, 5:10] = True  # five pixels of background
    assert iou_of(said, ids, 1) == pytest.approx(25 / 55)


def test_the_cards_figures() -> None:
    def sight(width: float, error: float | None, range_m: float = 4.0) -> Sight:
        return Sight(0, 0, 0, "X", range_m, width, False, True, error is not None, error or 0.0, 0.1)

    found = Findings(frame_sets=4, images=16, own_m=[0.02, float("nan"), 0.04])
    found.sights = [sight(40, 0.05), sight(40, -0.15), sight(40, 0.25), sight(40, None), sight(8, None)]
    found.false = [(0, 0, np.array([1.0, 0, 0]))]
    card = dict(rows(found))
    assert card["found, 30 to 80 px wide"] == "75 % (4)"
    assert card["found, 6 to 12 px wide"] == "0 % (1)"
    assert card["false in 500 pictures"] == "31"
    assert card["range at 0 to 5 m, median error"] == "15.0 % (3)"
    assert card["range at 0 to 5 m, bias"] == "5.0 %"
    assert (card["range errors inside 1 sigma"], card["range errors inside 2 sigma"]) == ("33 % (3)", "67 % (3)")
    assert card["own motion, estimated"] == "67 % (3)"
    assert card["own motion, median error, m"] == "0.03 (2)"


def test_flockds_own_pictures_of_a_moment_hold_its_drones_where_they_were_planned() -> None:
    config = cycles_card.drones("none")["pinhole"]
    rig = build_rig(config.rig)
    taken = draw_taken(MOMENTS[0], rig, *known_models(MOMENTS[0]))
    planned = np.subtract([one.poses[0].position for one in MOMENTS[0].neighbours], MOMENTS[0].own[0].position)
    assert taken.neighbours[0] - taken.position[0] == pytest.approx(planned)
    seen = 0
    for c, camera in enumerate(rig.cameras.values()):
        at = taken.position[0] + taken.R_ned_body[0] @ camera.T_body_camera.translation
        for n, place in enumerate(taken.neighbours[0]):
            mine = taken.range_m[0, c][taken.ids[0, c] == n + 1]
            if len(mine):
                seen += 1
                assert np.median(mine) == pytest.approx(np.linalg.norm(place - at), abs=taken.sizes_m[n])
    assert seen
    assert isinstance(taken.vehicles[0], VehicleState)


def test_a_real_airframe_is_drawn_with_its_propellers_blades_in_its_paint(tmp_path: Path) -> None:
    one = replace(MOMENTS[0], neighbours=(replace(MOMENTS[0].neighbours[0], airframe="a b", paint="dark"),))
    hubs, corners = np.array([[0.2, 0, -0.05], [-0.2, 0, -0.05]]), np.array([[0.1, 0, 0], [0, 0.1, 0], [-0.1, 0, 0.05]])
    np.savez(
        airframe_file(tmp_path, "a b"), vertices=corners, triangles=[[0, 1, 2]], colours=[[0.5, 0.5, 0.5]], hubs=hubs,
        radii=[0.1, 0.1], size_m=0.6,
    )  # fmt: skip
    (model,) = real_models(one, tmp_path)
    assert model.size_m == 0.6
    assert len(model.triangles) == 2 * (1 + 2 * 2)  # each from both sides
    assert model.colours[0] == pytest.approx(0.02 + 0.1 * 0.5)
    blades = model.vertices[3:].reshape(2, 4, 3)
    assert blades.mean(axis=1) == pytest.approx(hubs, abs=1e-6)
    assert np.linalg.norm(blades[:, 0] - blades[:, 1], axis=1) == pytest.approx(0.2, abs=1e-6)


def _box(path: Path, size: tuple[float, float, float]) -> None:
    trimesh.creation.box(size).export(path)


def test_an_airframe_of_an_sdf_is_as_large_as_its_propellers_reach(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _box(tmp_path / "body.stl", (0.3, 0.1, 0.1))
    _box(tmp_path / "blade.stl", (0.2, 0.0, 0.001))
    rotors = "".join(
        f"<link name='rotor_{k}'><pose>{x} {y} 0.05 0 0 0</pose><visual name='r'><geometry><mesh><uri>blade.stl</uri>"
        f"</mesh></geometry></visual></link>"
        for k, (x, y) in enumerate([(0.2, 0.2), (0.2, -0.2), (-0.2, 0.2), (-0.2, -0.2)])
    )
    (tmp_path / "model.sdf").write_text(
        f"<sdf><model><link name='base'><pose>0 0 0 0 0 0</pose><visual name='b'><geometry><mesh><uri>body.stl</uri>"
        f"</mesh></geometry></visual></link>{rotors}</model></sdf>"
    )
    monkeypatch.setitem(AIRFRAMES, "mine", Source("here", "none", "model.sdf", 0.4 * math.sqrt(2)))
    made = airframe(tmp_path, "mine")
    assert made.between_motors_m == pytest.approx(0.4 * math.sqrt(2))
    assert made.size_m == pytest.approx(0.4 * math.sqrt(2) + 0.2, rel=1e-3)
    assert made.rotors[0].hub[2] == pytest.approx(-0.05)  # above the body's middle, z down
    monkeypatch.setitem(AIRFRAMES, "mine", Source("here", "none", "model.sdf", 0.7))
    with pytest.raises(ValueError, match=r"0\.566 m apart, and its maker says 0\.7 m"):
        airframe(tmp_path, "mine")


def test_the_planned_attitude_is_flockds() -> None:
    from flockd.flight.geometry import rotation_from_euler

    assert rotation(0.1, -0.2, 2.0) == pytest.approx(rotation_from_euler(0.1, -0.2, 2.0))


@pytest.mark.parametrize(
    ("blender", "says"), [("nowhere/python", "bpy==5.0.1"), (sys.executable, "meshes are not part of flockd")]
)
def test_what_is_missing_is_said_in_a_sentence(
    blender: str, says: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "argv", ["cycles_card", "--blender", blender, "--keep", str(tmp_path), "--moments", "1"])
    monkeypatch.delenv("FLOCKD_MESHES", raising=False)
    with pytest.raises(SystemExit, match=says):
        cycles_card.main()


def test_moments_of_two_seeds_are_not_mixed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_job(Job((moment(1, 0, NAMES),), {}, "", 8, 1), tmp_path / "job.json")
    arguments = ["cycles_card", "--keep", str(tmp_path), "--only-rendered", "--moments", "1"]
    monkeypatch.setattr(sys, "argv", [*arguments, "--seed", "0"])
    with pytest.raises(SystemExit, match="holds other moments"):
        cycles_card.main()
    monkeypatch.setattr(sys, "argv", [*arguments, "--seed", "1"])
    with pytest.raises(SystemExit, match="nothing is rendered"):  # the same seed: goes on
        cycles_card.main()
