"""Choice of the linear solver for a matrix, its results, and stops of a search."""

import json
import signal
from pathlib import Path

import numpy as np
import pytest

import pbdkit
from pbdkit.equilibrium import linear_solver as linear
from pbdkit.equilibrium.linear_solver import Coordinates, linear_solver
from pbdkit.progress import StoppedError, Watch

sparse = pytest.importorskip("scipy.sparse")
NAMES = ["lu", "multigrid", "conjugate-gradients"]


def averaging(nx, ny, upwind=0.0):
    """1 - P of means of four neighbours, held all round; not symmetric where there is wind."""

    def along(n):
        return sparse.diags_array([np.full(n - 1, 1 - upwind), np.full(n - 1, 1 + upwind)],
                                  offsets=[-1, 1])  # fmt: skip

    mean = sparse.kron(along(nx), sparse.eye_array(ny)) + sparse.kron(
        sparse.eye_array(nx), along(ny)
    )
    return (sparse.eye_array(nx * ny) - mean / 4).tocsr()


def solver_of(matrix, method="auto", shape=(40, 20), **more):
    """With the unknowns on a sheet of that shape, held all round."""
    place = np.stack(np.unravel_index(np.arange(matrix.shape[0]), shape), axis=1).astype(float)
    around = np.array([(i, j) for i in (-1, shape[0]) for j in range(shape[1])], float)
    coordinates = Coordinates(1, place, around)
    return linear_solver(matrix, method, coordinates=coordinates, **more)


def test_method_depends_on_size_and_symmetry(monkeypatch):
    monkeypatch.setattr(linear, "LARGEST_LU", 700)
    small, medium, large = averaging(10, 20), averaging(30, 20), averaging(40, 20)
    assert isinstance(solver_of(small), linear.Dense)
    assert isinstance(solver_of(medium, shape=(30, 20)), linear.BandLU)
    assert isinstance(linear_solver(medium, "lu"), linear.SparseLU)
    assert solver_of(large).name == "multigrid, conjugate-gradients"
    assert solver_of(averaging(40, 20, 0.3)).name == "multigrid, gmres"
    assert solver_of(averaging(40, 20, 0.3), "conjugate-gradients").name == "gmres"
    monkeypatch.setattr(linear, "WIDEST_BAND", 19)
    assert isinstance(solver_of(large, "lu"), linear.SparseLU)


@pytest.mark.parametrize("upwind", [0.0, 0.3], ids=["symmetric", "not symmetric"])
@pytest.mark.parametrize("method", NAMES)
def test_every_method_solves(method, upwind):
    matrix = averaging(35, 30, upwind)
    b = np.random.default_rng(1).normal(size=matrix.shape[0]) * 1e-60
    solver = solver_of(matrix, method, (35, 30))
    assert np.linalg.norm(b - matrix @ solver.solve(b, 1e-9)) <= 2e-9 * np.linalg.norm(b)
    assert not solver.solve(np.zeros_like(b), 1e-9).any()
    assert (solver.iterations > 0) == (method != "lu")


@pytest.mark.parametrize("shape", [(40, 20), (20, 40)])
def test_bands_run_along_the_short_side_and_match_sparse_factors(shape):
    matrix = averaging(*shape, 0.3)
    band, other = solver_of(matrix, shape=shape), linear_solver(matrix, "lu")
    assert band._half == 20
    b = np.random.default_rng(3).normal(size=800)
    np.testing.assert_allclose(band.solve(b, 0.0), other.solve(b, 0.0), rtol=1e-11)
    np.testing.assert_allclose(
        band.solve_transposed(b, 0.0), other.solve_transposed(b, 0.0), rtol=1e-11
    )


def test_a_singular_band_is_refused():
    matrix = averaging(40, 20).tolil()
    matrix[7] = 0.0
    with pytest.raises(np.linalg.LinAlgError, match="zero"):
        solver_of(matrix.tocsr())


def test_multigrid_cycle_is_symmetric_and_contracts():
    matrix = averaging(60, 50)
    cycle = solver_of(matrix, "multigrid", (60, 50))._cycle
    a, b = np.random.default_rng(2).normal(size=(2, 3000))
    assert a @ cycle(b) == pytest.approx(b @ cycle(a), rel=1e-4)
    x = np.zeros_like(b)
    for _ in range(10):
        x += cycle(b - matrix @ x)
    assert np.linalg.norm(b - matrix @ x) < 1e-6 * np.linalg.norm(b)


@pytest.mark.filterwarnings("error")
def test_conjugate_gradients_on_an_indefinite_matrix_do_not_converge():
    matrix = sparse.diags_array([1.0, -1.0] * 300).tocsr()
    b = np.ones(600)
    x = solver_of(matrix, "conjugate-gradients").solve(b, 1e-9)
    assert not np.linalg.norm(b - matrix @ x) <= 1e-9 * np.linalg.norm(b)


HOLD = {"select": {"edge": "left"}, "motion": {"type": "hold"}}


def sheet(**parts):
    motion = {"type": "velocity", "velocity": [0.25, 0.0], "steps": 4}
    return {
        "name": "sheet",
        "lattice": {"type": "square", "a": 1.0},
        "body": {"type": "grid", "columns": 9, "rows": 7},
        "rule": {"type": "barycentre"},
        "leaders": [HOLD, {"select": {"edge": "right"}, "motion": motion}],
        "diagnostics": [{"type": "displacement"}],
        "steps": 20,
        "solver": {"type": "equilibrium", "method": "conjugate-gradients"},
    } | parts


RING = {"type": "ring", "inner": 6.0, "outer": 19.0, "centre": [20.0, 0.0]}
HOOK = {"type": "polygon", "vertices": [[0, 0], [40, 0], [40, 9], [9, 9], [9, 30], [0, 30]]}


@pytest.mark.parametrize("body", [RING, HOOK], ids=lambda body: body["type"])
@pytest.mark.parametrize("neighbours", ["coordination", "chebyshev"])
def test_multigrid_is_within_its_error_bound_on_bodies_with_corners(body, neighbours):
    left, right = ({"box": [x, -50.0, x + 6.0, 50.0]} for x in (0.0, 34.0))
    moved = {"type": "displace", "displacement": [1.0, 0.5]}
    leaders = [HOLD | {"select": left}, {"select": right, "motion": moved}]
    parts = {"body": body, "neighbours": {"type": neighbours}, "frame": {"type": "none"}}
    parts |= {"leaders": leaders}
    solver = {"type": "equilibrium", "tolerance": 1e-5, "method": "multigrid"}
    found = pbdkit.run(sheet(**parts, solver=solver), progress=False)
    direct = solver | {"tolerance": 1e-11, "method": "lu"}
    exact = pbdkit.run(sheet(**parts, solver=direct), progress=False)
    known = json.loads(found.attrs["certificate"])
    assert abs(found.u[-1] - exact.u[-1]).max() <= known["distance"] <= 1e-5


def stopping_at(monkeypatch, what, load="", by=lambda: signal.raise_signal(signal.SIGINT)):
    begin = Watch.begin

    def begun(self, now):
        if now == what and self.load.startswith(load):
            by()
        begin(self, now)

    monkeypatch.setattr(Watch, "begin", begun)


@pytest.mark.parametrize("what", ["assembling", "bounding the error", "solving"])
def test_interrupted_solve_keeps_the_initial_state(call, monkeypatch, what):
    Path("s.json").write_text(json.dumps(sheet()))
    stopping_at(monkeypatch, what)
    result = call("run", "s.json")
    assert result.code == 130
    assert result.err == (
        "pbdkit: interrupted: stopped before equilibrium was reached, after step 0; `pbdkit resume "
        "sheet.nc` continues it\n"
    )
    ds = pbdkit.open("sheet.nc")
    assert ds.attrs["status"] == "interrupted"
    assert ds.time.values.tolist() == [0]
    assert not ds.u.values.any()


def test_interrupted_loading_keeps_the_last_converged_increment(call, monkeypatch):
    fracture = {"type": "threshold", "thresholds": [9.0]}
    solver = {"type": "equilibrium", "increments": 4}
    Path("s.json").write_text(json.dumps(sheet(fracture=fracture, solver=solver)))
    stopping_at(monkeypatch, "solving", "step 4 of 4")
    assert call("run", "s.json").code == 130
    ds = pbdkit.open("sheet.nc")
    assert ds.time.values.tolist() == [0, 1, 2, 3]
    affine = 0.75 * ds.reference.isel(axis=0) / 8
    error = abs(ds.u.isel(time=-1, axis=0) - affine).where(ds.kind.isel(time=-1) < 2).max()
    assert error < 1e-7


def test_iteration_reports_progress_and_can_be_stopped():
    asked = []
    matrix = averaging(30, 30)
    watch = Watch(lambda: len(asked) == 3, lambda what, share: asked.append(share))
    solver = solver_of(matrix, "conjugate-gradients", (30, 30), watch=watch)
    with pytest.raises(StoppedError):
        solver.solve(np.ones(900), 1e-9)
    assert solver.iterations == 4
    assert all(0.0 <= share < 1.0 for share in asked)


def test_progress_is_reported_as_phase_and_fraction(monkeypatch):
    from pbdkit.equilibrium.load_stepping import equilibrate
    from pbdkit.scene.scene import build_scene
    from pbdkit.stepping.state import initial_state

    told = []
    scene = build_scene(pbdkit.Experiment(**sheet()))
    equilibrate(
        scene, initial_state(scene), Watch(show=lambda what, share: told.append((what, share)))
    )
    phases = list(dict.fromkeys(what for what, _ in told))
    assert phases == ["assembling", "bounding the error", "solving"]
    shares = [share for what, share in told if what == "solving"]
    assert shares[0] == 0.0
    assert shares[-1] == 1.0


def test_progress_is_drawn_on_a_terminal(monkeypatch, capsys):
    monkeypatch.setattr("pbdkit.progress.DELAY_S", 0.0)
    monkeypatch.setattr("pbdkit.progress.REFRESH_S", 0.0)
    monkeypatch.setenv("FORCE_COLOR", "1")
    pbdkit.run(sheet(), progress=True)
    assert "solving" in capsys.readouterr().err
