"""Scenarios: all load, mistakes are named with their cure."""

import warnings
from dataclasses import fields

import pytest
from gpvo.cameras.rectify import Rectifier
from gpvo.errors import GpvoError
from gpvo.sim import scenario as sc
from gpvo.sim.points import simulate_points
from gpvo.sim.points_scenario import _RULES, PointsScenario, check_values, scenarios
from gpvo.sim.rig import camera_rig


def test_every_scenario_loads_and_explains_itself():
    assert {"tunnel", "tunnel-clean", "tunnel-noise", "tunnel-bursts", "tunnel-dark"} <= set(sc.names())
    assert {"lunar-straight", "room-t265", "room-flown"} <= set(sc.names())
    assert set(scenarios()) <= set(sc.names())
    assert all(sc.load_scenario(n).about for n in sc.names())


@pytest.mark.parametrize("name", sorted(scenarios()))
def test_points_scenario_is_the_known_one(name):
    assert sc.points_scenario(sc.load_scenario(name)) == scenarios()[name]


@pytest.mark.parametrize(("name", "camera"), [("tunnel-clean", "t265"), ("street", "t265"), ("room-t265", "euroc"),
                                              ("room-flown", "t265"), ("tunnel", "pinhole")])  # fmt: skip
def test_a_camera_that_was_asked_for_is_flown_without_images_too(name, camera):
    flown = sc.points_scenario(sc.load_scenario(name, {"camera": camera}))
    assert flown.camera == Rectifier(camera_rig(camera)).camera


@pytest.mark.parametrize("name", ["tunnel", "tunnel-dark"])
def test_the_others_fly_without_images_too(name):
    flight = simulate_points(sc.points_scenario(sc.load_scenario(name, {"duration_s": 6.0})), 1)
    assert len(flight.t_s) == 121


@pytest.mark.parametrize(
    "overrides, message",
    [
        ({"spede_mps": 1}, "nearest: speed_mps"),
        ({"speed_mps": "quick"}, "speed_mps"),
        ({"duration_s": -1}, "duration_s"),
        ({"camera": "gopro"}, "camera"),
        ({"calibration.focl": 0.1}, "calibration"),
        ({"late": 0.1, "late_s": 0.2}, "late_s"),
        ({"late": 0.1, "late_s": 0.0065, "rate_hz": 150.0}, "late_s"),  # some frames are 6 ms apart
        ({"name.x": 1}, "not a table"),
    ],
)
def test_mistakes_are_named(overrides, message):
    with pytest.raises(GpvoError, match=message) as caught:
        sc.load_scenario("tunnel", overrides)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "name, value",
    [("sigma_px", "fast"), ("sigma_px", -0.1), ("drop", 1.5), ("tracks", 0), ("tracks", 10.5), ("cars", True),
     ("frozen", [3.0, 1.0]), ("dark", 4.0), ("causes", [["dust"]]), ("causes", []), ("world_seed", -1),
     ("episodes_share", 0.9), ("waypoints", [[1, 2]]), ("waypoints", [1, 2, 3]),
     ("reach_m", float("nan")), ("camera", "t265"), ("tolerance", {"focal": 0.1})],
)  # fmt: skip
def test_a_value_of_points_that_makes_no_flight_is_refused_before_any(name, value):
    with pytest.raises(GpvoError, match=f"^points.{name} is ") as caught:
        sc.load_scenario("tunnel", {f"points.{name}": value})
    assert "\n" not in str(caught.value)
    with pytest.raises(GpvoError, match=f"^{name} is "):
        simulate_points("tunnel-clean", 0, **{name: value})


def test_every_value_of_points_has_a_rule_that_the_known_flights_keep():
    ruled = [name for names, _, _ in _RULES for name in names.split()]
    assert sorted(ruled) == sorted(f.name for f in fields(PointsScenario))
    for known in scenarios().values():
        check_values(vars(known))


def test_what_a_flight_has_with_images_it_has_without():
    given = {"world_seed": 4, "rest_s": 1.0, "episodes_share": 0.4, "causes": ["dust"], "duration_s": 20.0}
    flown = sc.points_scenario(sc.load_scenario("tunnel", given))
    assert {name: getattr(flown, name) for name in given} == given | {"causes": ("dust",)}
    flight = simulate_points(flown, 1)
    assert sum(e.end_s - e.begin_s for e in flight.episodes) == pytest.approx(8.0, abs=1.5)
    moved_m = abs(flight.T_world_cam[:, :3, 3] - flight.T_world_cam[0, :3, 3]).max(axis=1)
    assert 1.0 <= flight.t_s[(moved_m > 1e-3).argmax()] < 1.5


def test_waypoints_are_flown_without_images_too():
    places = [[1.0, 0.0, 0.0], [5.0, 0.5, 0.2], [9.0, 0.0, 0.0]]
    given = {"path": "waypoints", "waypoints": places, "duration_s": 14.0}
    flight = simulate_points(sc.points_scenario(sc.load_scenario("tunnel", given)), 1)
    apart_m = abs(flight.motion.position_m[:, None] - places).max(axis=2).min(axis=0)
    assert apart_m.max() < 0.1


@pytest.mark.parametrize(
    "name, overrides, told",
    [
        ("tunnel", {"noise_sigma": 0.02}, ["noise_sigma is not used without images; set points.sigma_px"]),
        ("tunnel", {"noise_sigma": 0.02, "points.sigma_px": 0.4}, []),
        ("tunnel-noise", {}, []),
        ("lunar-straight", {"camera_pitch_deg": 0.0}, ["camera_pitch_deg is not used without images"]),
    ],
)
def test_what_only_images_show_is_not_dropped_in_silence(name, overrides, told):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        sc.warn_of_unused(sc.load_scenario(name, overrides))
    assert [str(w.message) for w in caught] == told


def test_unknown_names():
    with pytest.raises(GpvoError, match="nearest: tunnel-clean"):
        sc.load_scenario("tunel-clean")
    with pytest.raises(GpvoError, match="nearest: sigma_px"):
        sc.points_scenario(sc.load_scenario("tunnel", {"points.sigma_pix": 1.0}))


def test_own_file(tmp_path):
    file = tmp_path / "mine.toml"
    file.write_text('world = "room"\npath = "wander"\n[points]\nsigma_px = 0.3\n')
    mine = sc.load_scenario(str(file), {"duration_s": 9.0})
    assert (mine.name, mine.world, mine.duration_s) == ("mine", "room", 9.0)
    assert sc.points_scenario(mine).sigma_px == 0.3
    file.write_text("world = [")
    with pytest.raises(GpvoError, match="as TOML"):
        sc.load_scenario(str(file))
    with pytest.raises(GpvoError, match="cannot be read"):
        sc.load_scenario(str(tmp_path / "none.toml"))


def test_a_calibration_file_is_a_camera(tmp_path):
    bent = "distortion_model: radtan, distortion_coeffs: [-0.1, 0.01, 0, 0]"
    lens = f"{{camera_model: pinhole, {bent}, resolution: [640, 400]"
    (tmp_path / "rig.yaml").write_text(
        f"cam0: {lens}, intrinsics: [420, 421, 318, 201]}}\n"
        f"cam1: {lens}, intrinsics: [419, 420, 322, 199],\n"
        "  T_cn_cnm1: [[1, 0, 0, -0.075], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}\n"
    )
    scenario = sc.load_scenario("tunnel", {"camera": str(tmp_path / "rig.yaml")})
    camera = sc.points_scenario(scenario).camera
    assert camera.baseline_m == pytest.approx(0.075)
    assert camera.fx_px == pytest.approx(420, rel=0.1)
    (tmp_path / "rig.yaml").write_text("cam0: 3\n")
    with pytest.raises(GpvoError, match=r"rig\.yaml"):
        sc.points_scenario(scenario)


@pytest.mark.parametrize("name", ["street", "street-traffic", "tunnel-smoke", "lunar-dust"])
def test_what_has_no_pictures_says_so(name):
    with pytest.raises(GpvoError, match="has no images"):
        sc.require_pictures(sc.load_scenario(name))
    sc.require_pictures(sc.load_scenario("tunnel"))


@pytest.mark.parametrize("value", [float("inf"), float("nan"), 1e300, -0.6])
@pytest.mark.parametrize("table", ["calibration", "calibration_offset"])
def test_a_calibration_that_no_pair_has_is_refused(table, value):
    """An infinite rotation gave tracks that are not numbers."""
    with pytest.raises(GpvoError, match=rf"{table}\.rotation_rad = "):
        sc.load_scenario("tunnel-bursts", {f"{table}.rotation_rad": value})
