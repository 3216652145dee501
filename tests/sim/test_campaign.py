"""Campaigns and the command."""

import json
import os

import pytest
from gpvo.cli import simulate as command
from gpvo.cli.common import with_common_options
from gpvo.errors import GpvoError
from gpvo.parallel import map_jobs
from gpvo.sim import scenario as sc
from typer.testing import CliRunner


def test_points_campaign_is_the_same_on_two_jobs(tmp_path):
    scenario = sc.load_scenario("tunnel-clean", {"duration_s": 5.0})
    one = sc.fly_campaign(scenario, [0, 2], tmp_path / "one", points=True)
    two = sc.fly_campaign(scenario, [0, 2], tmp_path / "two", points=True, jobs=2)
    assert [f.seed for f in one] == [0, 2]
    assert not any(f.error for f in one + two)
    for a, b in zip(one, two):
        assert a.path.read_bytes() == b.path.read_bytes()


@pytest.mark.slow
def test_a_dask_cluster_of_two_workers_makes_the_same_bytes(tmp_path):
    distributed = pytest.importorskip("distributed", reason="needs the extra gpvo[dask]")
    scenario = sc.load_scenario("tunnel-clean", {"duration_s": 5.0})
    here = sc.fly_campaign(scenario, [0, 2], tmp_path / "here", points=True)
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None) as cluster:
        there = sc.fly_campaign(
            scenario, [0, 2], tmp_path / "there", points=True, backend="dask", scheduler=cluster.scheduler_address
        )
    assert [f.error for f in there] == ["", ""]
    for a, b in zip(here, there, strict=True):
        assert a.path.read_bytes() == b.path.read_bytes()


def test_one_failure_does_not_stop_the_others(tmp_path, monkeypatch):
    def flaky(scenario, seed, out, points):
        if seed == 1:
            raise GpvoError("the quadrotor crashes")
        return sc.Flight(seed, out, 10)

    monkeypatch.setattr(sc, "fly", flaky)
    flights = sc.fly_campaign(sc.load_scenario("tunnel"), [0, 1, 2], tmp_path, points=True)
    assert [bool(f.error) for f in flights] == [False, True, False]


def test_unknown_backend(tmp_path):
    with pytest.raises(GpvoError, match="local or dask"):
        sc.fly_campaign(sc.load_scenario("tunnel"), [0], tmp_path, backend="slurm")


@pytest.mark.parametrize("text, seeds", [("0..3", [0, 1, 2, 3]), ("1,4,7", [1, 4, 7]), ("5", [5]), ("1..2,2", [1, 2])])
def test_seeds(text, seeds):
    assert command._seeds(text) == seeds


@pytest.mark.parametrize("text", ["", "a", "3..1", "-1", "0..999999999"])
def test_seeds_that_are_none(text):
    with pytest.raises(GpvoError, match="is not a list of seeds"):
        command._seeds(text)


def test_assignments():
    assert command._assignment("noise_sigma=0.05") == ("noise_sigma", 0.05)
    assert command._assignment("world=room") == ("world", "room")
    assert command._assignment("dark=[3, 5]") == ("dark", [3, 5])
    with pytest.raises(GpvoError, match="key=value"):
        command._assignment("noise")


def test_command(tmp_path):
    import typer

    app = typer.Typer()
    app.callback()(lambda: None)
    app.command()(with_common_options(command.simulate))
    run = CliRunner().invoke
    listed = run(app, ["simulate", "--list"])
    assert "lunar-straight" in listed.output
    out = tmp_path / "a.npz"
    made = run(app, ["simulate", "room-t265", "--points", "-o", str(out), "--duration", "5", "--json"])
    assert json.loads(made.output)["flights"][0]["frames"] == 101
    assert out.is_file()
    as_jpg = run(app, ["simulate", "tunnel", "--preview", str(tmp_path / "a.jpg")])
    assert "a.jpg: does not have the suffix of a PNG (end it in .png)" in str(as_jpg.exception)
    assert "nowhere to write" in str(run(app, ["simulate", "room-t265"]).exception)
    (taken := tmp_path / "s" / "seed_3.npz").mkdir(parents=True)
    refused = run(app, ["simulate", "tunnel", "--points", "--seeds", "3", "-o", str(taken.parent), "--duration", "5"])
    assert refused.output.startswith(f"{taken}: is a folder")


def test_a_worker_that_is_killed_is_one_line():
    with pytest.raises(GpvoError, match="a worker process was killed.*fewer --jobs"):
        map_jobs(os._exit, [(9,), (9,)], jobs=2)


@pytest.mark.parametrize(
    ("given", "told"), [({"jobs": 0}, "0 jobs.*--jobs 1"), ({"scheduler": "tcp://x"}, "--backend dask")]
)
def test_workers_that_cannot_be_are_one_line(given, told):
    with pytest.raises(GpvoError, match=told):
        map_jobs(abs, [(-1,), (2,)], **given)
