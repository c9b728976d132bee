"""Files: a run comes back bit for bit, VTK's layout holds, nothing written is lost, and nothing damaged is believed."""

import dataclasses
import json
import re
import shutil
from threading import Thread

import equinox as eqx
import h5py
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from disk import full_beyond
from helpers import DESCRIPTIONS, TRANSFERS, block, cloud, ids, thorough

import mpmjax as mpm
import mpmjax.io._frame_writer
import mpmjax.io._run_file
import mpmjax.io._runs
from mpmjax.analysis import FIELDS, density, fields_of, pressure, von_mises
from mpmjax.io._frame_writer import FrameWriter
from mpmjax.io._runs import load, record, save
from mpmjax.io._transactional_file import StagedFile, undisturbed
from mpmjax.simulation._diffrax import Problem, RolloutState, initial_state
from mpmjax.simulation._run import Run, RunStatistics, no_steps
from mpmjax.simulation._simulate import integrate
from mpmjax.state._particles import Particles, state_of, with_state
from mpmjax.state._preparation import prepare

DTYPES = {"float32": jnp.float32, "float64": jnp.float64}
STEPPERS = {
    "explicit": (mpm.Explicit(), 5e-3),
    "semi_implicit": (mpm.SemiImplicit(solver=mpm.implicit.ConjugateResidual(1e-4)), 3e-2),
}


def problem(run: Run) -> Problem:
    """What of a run does not change."""
    return Problem(run.scene, run.final, run.dt, run.method)


def made_up(d: int, dtype=jnp.float64, description=DESCRIPTIONS["updated"], transfer=TRANSFERS["apic"], p=7) -> Run:
    """A run of random numbers: three frames, none of them simulated."""
    grid, particles = cloud(d, p=p)
    particles = jax.tree.map(lambda a: a.astype(dtype), particles)
    law = mpm.FixedCorotated(jnp.asarray(1 / 3, dtype), jnp.asarray(0.3, dtype))
    scene = mpm.Scene(grid, law, gravity=(0.1,) * d, description=description, transfer=transfer)
    scene = jax.tree.map(lambda a: jnp.asarray(a, dtype), scene)
    rng = np.random.default_rng(1)
    particles = prepare(scene, particles)
    frames = jax.tree.map(lambda a: jnp.asarray(rng.normal(size=(3, *a.shape)), dtype), state_of(particles))
    final = with_state(particles, jax.tree.map(lambda a: a[-1], frames))
    floats = "worst_residual", "force_error", "force_scale"
    counts = {f.name: jnp.asarray(i, jnp.int32) for i, f in enumerate(dataclasses.fields(RunStatistics), 7)}
    return Run(
        scene=scene,
        method=jax.tree.map(lambda a: jnp.asarray(a, dtype), mpm.SemiImplicit(beta=0.7)),
        dt=jnp.asarray(1e-3, dtype),
        steps=jnp.asarray([0, 5, 7], dtype),
        frames=frames,
        observed=None,
        final=final,
        final_step=jnp.asarray(7, dtype),
        statistics=RunStatistics(**counts | dict.fromkeys(floats, jnp.asarray(1 / 7, dtype))),
    )


def jelly(dtype=jnp.float64, **scene: object) -> tuple[mpm.Scene, Particles]:
    """A bar thrown along its axis (1-D compiles fastest), one end held by a grip whose speed changes with time."""
    motion = mpm.Motion((0.0, 0.02, 0.3), ((0.0,), (0.01,), (0.05,)))
    grip = mpm.Grip(mpm.Box((0.3,), (1.0,)), motion)
    scene, particles = block(1, gravity=(-0.1,), boundary=grip, **scene)
    particles = eqx.tree_at(lambda q: q.v, particles, jnp.sin(20 * particles.x) / 10)
    return scene, jax.tree.map(lambda a: a.astype(dtype), particles)


def assert_same(a: object, b: object) -> None:
    """The same tree with the same numbers to the last bit."""
    assert jax.tree.structure(a) == jax.tree.structure(b)
    for one, other in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        assert one.dtype == other.dtype
        assert np.array_equal(one, other)


# A run in a file -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("description", **ids(DESCRIPTIONS))
@pytest.mark.parametrize("dtype", **ids(DTYPES))
@pytest.mark.parametrize("d", [2, *thorough(1, 3)])
def test_a_run_comes_back_bit_for_bit(d, dtype, description, tmp_path):
    """load(save(run)) = run, every leaf of it."""
    run = made_up(d, dtype, description)
    save(tmp_path / "run.h5", run)
    assert_same(load(tmp_path / "run.h5"), run)


@pytest.mark.parametrize("transfer", **ids(TRANSFERS))
def test_what_a_transfer_does_not_need_is_not_stored(transfer, tmp_path):
    """The affine velocity is in the file with APIC only."""
    run = made_up(2, transfer=transfer)
    save(tmp_path / "run.h5", run)
    assert_same(load(tmp_path / "run.h5"), run)
    with h5py.File(tmp_path / "run.h5") as file:
        assert ("affine_velocity" in file["VTKHDF/PointData"]) == transfer.affine


@pytest.mark.parametrize(
    "laws", [*thorough(mpm.Snow()), (mpm.NeoHookean(1e4, 0.3), mpm.Snow()), *thorough(((mpm.Snow(), mpm.Snow(1e5)),))]
)
def test_what_laws_remember_comes_back(laws, tmp_path):
    """One law or several: F and history of each of them, bit for bit; in ParaView a dataset has NaN where nothing is
    remembered."""
    grid, particles = cloud(2, p=7)
    bare = [
        Particles(*(a[rows] for a in (particles.x, particles.v, particles.mass, particles.volume)))
        for rows in (slice(3), slice(3, 7))
    ]
    scene = jax.tree.map(lambda a: jnp.asarray(a, float), mpm.Scene(grid, laws))
    particles = prepare(scene, mpm.join(*bare))
    rng = np.random.default_rng(1)
    frames = jax.tree.map(lambda a: jnp.asarray(rng.normal(size=(3, *a.shape))), state_of(particles))
    final = with_state(particles, jax.tree.map(lambda a: a[-1], frames))
    run = dataclasses.replace(made_up(2), scene=scene, frames=frames, final=final)
    save(tmp_path / "run.h5", run)
    assert_same(load(tmp_path / "run.h5"), run)
    with h5py.File(tmp_path / "run.h5") as file:
        packed = file["VTKHDF/PointData/plastic_volume"][:7]
        assert np.isnan(packed[:3]).all() == (isinstance(laws, tuple) and isinstance(laws[0], mpm.NeoHookean))
        assert np.isfinite(packed[3:]).all()


def test_parameters_of_each_particle_come_back(tmp_path):
    """Arrays of the scene that are too long for text lie beside it."""
    run = made_up(2, p=100)
    moduli = jnp.asarray(np.random.default_rng(0).uniform(1, 2, 100))
    run = eqx.tree_at(lambda r: r.scene.material.youngs_modulus, run, moduli)
    save(tmp_path / "run.h5", run)
    assert_same(load(tmp_path / "run.h5"), run)


def test_a_run_without_frames_is_saved_as_its_final_state(tmp_path):
    """The final state becomes the only frame."""
    run = made_up(2)
    bare = eqx.tree_at(lambda r: (r.frames, r.steps), run, (None, jnp.zeros(0)), is_leaf=lambda x: x is None)
    save(tmp_path / "run.h5", bare)
    back = load(tmp_path / "run.h5")
    assert np.array_equal(back.steps, [7])
    assert_same(back.final, run.final)
    assert_same(jax.tree.map(lambda a: a[0], back.frames), state_of(run.final))


def test_saving_is_all_or_nothing(tmp_path, monkeypatch):
    """A save that fails on the way leaves the file that was there, and no litter."""
    path, run = tmp_path / "run.h5", made_up(2)
    save(path, run)
    monkeypatch.setattr(mpmjax.io._frame_writer, "set_count", lambda *_: (_ for _ in ()).throw(OSError("disk full")))
    with pytest.raises(OSError, match=r"frame 0 could not be written \(disk full\)"):
        save(path, eqx.tree_at(lambda r: r.dt, run, jnp.asarray(2e-3)))
    assert_same(load(path), run)
    assert [p.name for p in tmp_path.iterdir()] == ["run.h5"]


@pytest.mark.parametrize("d", [2, *thorough(1, 3)])
@pytest.mark.parametrize("dtype", **ids(DTYPES))
def test_the_file_has_the_layout_that_vtk_reads(d, dtype, tmp_path):
    """Temporal PolyData, field by field."""
    run, n, p = made_up(d, dtype), 3, 7
    save(tmp_path / "run.h5", run)
    x, v, F, C = (np.asarray(getattr(run.frames, name)).reshape(n * p, d, -1) for name in "xvFC")
    x, v = x[..., 0], v[..., 0]
    full = np.tile(np.eye(3), (n * p, 1, 1))
    full[:, :d, :d] = F
    affine = np.zeros((n * p, 3, 3))
    affine[:, :d, :d] = C
    with h5py.File(tmp_path / "run.h5") as file:
        vtk = file["VTKHDF"]
        assert vtk.attrs["Version"].tolist() == [2, 0]
        kind = vtk.attrs.get_id("Type")
        assert kind.get_type().get_class() == h5py.h5t.STRING
        assert not kind.get_type().is_variable_str()
        assert vtk.attrs["Type"] == b"PolyData"
        wanted = {
            "NumberOfPoints": [p],
            "Points": np.pad(x, ((0, 0), (0, 3 - d))),
            "PointData/velocity": np.pad(v, ((0, 0), (0, 3 - d))),
            "PointData/deformation_gradient": full.reshape(-1, 9),
            "PointData/affine_velocity": affine.reshape(-1, 9),
            "PointData/pressure": np.concatenate([pressure(run.scene, run.frame(i)) for i in range(n)]),
            "PointData/von_mises": np.concatenate([von_mises(run.scene, run.frame(i)) for i in range(n)]),
            "PointData/material": np.ones(n * p),
            "PointData/J": F[:, 0, 0] if d == 1 else np.linalg.det(F),
            "Vertices/NumberOfCells": [p],
            "Vertices/NumberOfConnectivityIds": [p],
            "Vertices/Connectivity": np.arange(p),
            "Vertices/Offsets": np.arange(p + 1),
            "Steps/Values": np.asarray([0, 5, 7]) * float(run.dt),
            "Steps/PartOffsets": [0, 0, 0],
            "Steps/NumberOfParts": [1, 1, 1],
            "Steps/PointOffsets": [0, p, 2 * p],
            "Steps/CellOffsets": np.zeros((n, 4)),
            "Steps/ConnectivityIdOffsets": np.zeros((n, 4)),
        }
        for name in ("velocity", "deformation_gradient", "affine_velocity", "J", "pressure", "von_mises", "material"):
            wanted[f"Steps/PointDataOffsets/{name}"] = [0, p, 2 * p]
        for name in ("Lines", "Polygons", "Strips"):
            wanted |= {f"{name}/NumberOfCells": [0], f"{name}/NumberOfConnectivityIds": [0]}
            wanted |= {f"{name}/Connectivity": [], f"{name}/Offsets": [0]}
        found = {}
        vtk.visititems(lambda name, item: found.update({name: item}) if isinstance(item, h5py.Dataset) else None)
        assert set(found) == set(wanted)
        for name, value in wanted.items():
            assert np.array_equal(found[name][...], value), name
            assert (found[name].fletcher32, found[name].compression) == (True, "gzip"), name
            real = name == "Points" or name.startswith("PointData")
            kinds = {"Steps/Values": np.float64, "PointData/material": np.int32}
            assert found[name].dtype == kinds.get(name, dtype if real else np.int64), name
        assert vtk["Steps"].attrs["NSteps"] == n
        assert vtk["Steps"].attrs["NSteps"].dtype == np.int64


@pytest.mark.parametrize("d", [2, *thorough(1, 3)])
def test_vtk_reads_every_step_and_array(d, tmp_path):
    """The real one, which ParaView and pyvista read by: times, points and all data of each step, to the last bit."""
    hdf = pytest.importorskip("vtkmodules.vtkIOHDF")
    from vtkmodules.util.numpy_support import vtk_to_numpy

    run, p = made_up(d), 7
    save(tmp_path / "run.vtkhdf", run)
    reader = hdf.vtkHDFReader()
    reader.SetFileName(str(tmp_path / "run.vtkhdf"))
    reader.UpdateInformation()
    assert reader.GetNumberOfSteps() == 3
    with h5py.File(tmp_path / "run.vtkhdf") as file:
        vtk = file["VTKHDF"]
        for i in range(3):
            reader.SetStep(i)
            reader.Update()
            output, rows = reader.GetOutput(), slice(i * p, (i + 1) * p)
            assert output.GetNumberOfVerts() == p
            assert reader.GetTimeValue() == vtk["Steps/Values"][i]
            assert np.array_equal(vtk_to_numpy(output.GetPoints().GetData()), vtk["Points"][rows])
            data = output.GetPointData()
            read = {data.GetArrayName(k): vtk_to_numpy(data.GetArray(k)) for k in range(data.GetNumberOfArrays())}
            assert set(read) == set(vtk["PointData"])
            for name, values in read.items():
                assert np.array_equal(values, vtk["PointData"][name][rows]), name


def test_fields_are_those_that_were_asked_for(tmp_path):
    """Each frame's own, whoever wrote it: `record`, a resumed one, which keeps the file's, or `save`."""
    (scene, particles), kwargs = jelly(), {"dt": 5e-3, "save_every": 2}
    path, other = tmp_path / "run.vtkhdf", tmp_path / "saved.vtkhdf"
    record(path, scene, particles, t1=0.02, fields=list(FIELDS), **kwargs)
    record(path, scene, particles, t1=0.03, resume=True, **kwargs)
    run = load(path)
    save(other, run, fields=("density", "stress"))
    p = run.final.count
    with h5py.File(path) as recorded, h5py.File(other) as saved:
        for i in range(len(run)):
            rows, frame = slice(i * p, (i + 1) * p), run.frame(i)
            for name, field in fields_of(run.scene, frame, tuple(FIELDS)).items():
                assert np.array_equal(
                    recorded["VTKHDF/PointData"][name][rows], np.reshape(field, (p, *[9] * (field.ndim == 3)))
                )
            np.testing.assert_allclose(saved["VTKHDF/PointData/density"][rows], density(run.scene, frame), rtol=1e-12)
            np.testing.assert_allclose(
                saved["VTKHDF/PointData/stress"][rows],
                mpm.stress(run.scene, frame).reshape(p, 9),
                rtol=1e-12,
                atol=1e-9,
            )
        states = {"velocity", "J", "deformation_gradient", "affine_velocity"}
        assert set(saved["VTKHDF/PointData"]) == states | {"density", "stress"}
    with pytest.raises(ValueError, match=r"fields must be some of speed, .* particle, got 'presure'"):
        save(other, run, fields=("presure",))
    assert_same(load(other), run)


@pytest.mark.parametrize("frame", [0, 2, -1])
def test_one_frame_is_read_without_the_rest(frame, tmp_path):
    """Of the others a file may have lost the data."""
    run, path = made_up(2), tmp_path / "run.h5"
    save(path, run)
    with h5py.File(path, "r+") as file:
        points = file["VTKHDF/Points"]
        points[7 * (frame % 3) - 7 : 7 * (frame % 3) or 21] = 0  # of another
    one = load(path, frame=frame)
    assert_same((one.frame(0), one.steps), (run.frame(frame), run.steps[np.asarray([frame])]))
    assert_same(one.final, run.frame(frame))
    with pytest.raises(ValueError, match="not what was written"):
        load(path)
    with pytest.raises(ValueError, match="has 3 frames, there is no frame 3"):
        load(path, frame=3)


def test_a_run_is_a_table(tmp_path):
    """Energies, forces and statistics of each frame, by name and unit; from a file the statistics too."""
    scene, particles = jelly(boundary_forces=True)
    record(tmp_path / "run.h5", scene, particles, t1=0.02, dt=5e-3, save_every=2, method=STEPPERS["semi_implicit"][0])
    run, table = load(tmp_path / "run.h5"), mpm.table(tmp_path / "run.h5")
    np.testing.assert_array_equal(table["time [s]"], run.times)
    np.testing.assert_array_equal(table["boundary 0 force x [N]"][1:], run.boundary_forces().force[:, 0, 0])
    energies = [float(mpm.energy(scene, run.frame(i)).elastic) for i in range(3)]
    np.testing.assert_allclose(table["elastic energy [J]"], energies, rtol=1e-12)
    assert table["iterations"][0] == 0
    assert table["iterations"][-1] == run.statistics.iterations > 0
    assert set(table) - set(mpm.table(run)) == {f.name for f in dataclasses.fields(RunStatistics)}


def test_the_file_says_what_it_holds(tmp_path):
    """Units, dtype, dimension and the scene can be read without this package."""
    run = made_up(2)
    save(tmp_path / "run.h5", run)
    with h5py.File(tmp_path / "run.h5") as file:
        own = file["mpmjax"]
        assert own.attrs["units"].startswith(b"SI")
        assert (own.attrs["format"], own.attrs["d"], own.attrs["dtype"]) == (9, 2, b"float64")
        scene = json.loads(own["scene"][...].tobytes())
        assert scene["material"] == {"kind": "FixedCorotated", "youngs_modulus": 1 / 3, "poisson_ratio": 0.3}
        assert own["frames"]["step"].tolist() == [0, 5, 7]
        assert own["frames"]["iterations"].tolist() == [-1, -1, int(run.statistics.iterations)]


# A run recorded as it goes -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [None, 2])
def test_the_program_of_a_run_calls_no_host(count):
    """One that does is not kept by JAX's cache, so that each process compiles it anew."""
    scene, particles = jelly()
    problem = Problem(scene, prepare(scene, particles), jnp.asarray(5e-3), mpm.Explicit(), start=jnp.zeros(()))
    arguments = {"until": np.asarray(np.inf), "max_steps": 3}
    number = None if count is None else jnp.asarray(float(count))
    assert "callback" not in integrate.lower(problem, initial_state(problem), number, **arguments).as_text()


@pytest.mark.parametrize("stepper", **ids(STEPPERS, "explicit"))
@pytest.mark.parametrize("dtype", **ids(DTYPES, "float64", ()))
@pytest.mark.parametrize("law", [None, *thorough(mpm.Snow(1e4, critical_stretch=1e-4))], ids=["elastic", "snow"])
def test_recorded_resumed_and_simulated_runs_are_equal_bit_for_bit(law, dtype, stepper, tmp_path):
    """Chunks, a restart between frames and one single solve give the same numbers, from one compilation."""
    (method, dt), (scene, particles) = stepper, jelly(dtype, **({} if law is None else {"material": law}))
    kwargs = {"dt": dt, "method": method, "save_every": 4}
    single = mpm.simulate(scene, particles, t1=14 * dt, **kwargs)
    before = integrate._cached._cache_size()
    whole = record(tmp_path / "whole.h5", scene, particles, t1=14 * dt, **kwargs)
    record(tmp_path / "parts.h5", scene, particles, t1=5 * dt, **kwargs)
    resumed = record(tmp_path / "parts.h5", scene, particles, t1=14 * dt, resume=True, **kwargs)
    assert integrate._cached._cache_size() == before + 1
    assert_same(load(tmp_path / "whole.h5"), single)
    assert_same((whole.final, whole.statistics), (single.final, single.statistics))
    assert_same((resumed.final, resumed.statistics), (single.final, single.statistics))
    parts = load(tmp_path / "parts.h5")
    assert parts.steps.tolist() == [0, 4, 5, 8, 12, 14]
    kept = jnp.asarray([0, 1, 3, 4, 5])
    assert_same(jax.tree.map(lambda a: a[kept], parts.frames), single.frames)
    assert_same(parts.statistics, single.statistics)


@pytest.mark.thorough
def test_a_saved_run_can_be_resumed(tmp_path):
    """What `save` writes and what `record` writes is one kind of file, in the total description too."""
    scene, particles = jelly(description=mpm.TotalLagrangian())
    kwargs = {"dt": 5e-3, "save_every": 4}
    whole = record(tmp_path / "whole.h5", scene, particles, t1=0.06, **kwargs)
    save(tmp_path / "run.h5", mpm.simulate(scene, particles, t1=0.03, **kwargs))
    resumed = record(tmp_path / "run.h5", scene, particles, t1=0.06, resume=True, **kwargs)
    assert_same((resumed.final, resumed.statistics), (whole.final, whole.statistics))


def test_a_file_being_written_can_be_read(tmp_path):
    """Every frame appended is on its way to the disk: a copy of the open file, as a kill leaves it, holds them all."""
    path, run = tmp_path / "run.h5", made_up(2)
    frames = [jax.tree.map(lambda a, i=i: a[i], run.frames) for i in range(3)]
    with FrameWriter.create(path, problem(run)) as writer:
        for i, frame in enumerate(frames):
            writer.append(i, RolloutState(frame, None), run.statistics)
            shutil.copy(path, tmp_path / "copy.h5")
            for name in (path, tmp_path / "copy.h5"):
                assert_same(load(name).frames, jax.tree.map(lambda a, i=i: a[: i + 1], run.frames))


def test_a_signal_is_told_what_the_file_holds(tmp_path, monkeypatch):
    """Also where it comes right after a frame has reached the disk."""
    path, run = tmp_path / "run.h5", made_up(2)
    commit, told, threads = StagedFile.commit, [], []

    def signalled():
        with undisturbed():
            told.append((writer.standing(""), len(load(path))))

    def committed(file):
        commit(file)
        if len(threads) < 2:
            threads.append(Thread(target=signalled))
            threads[-1].start()
            threads[-1].join(0.2)

    with FrameWriter.create(path, problem(run)) as writer:
        frame = RolloutState(jax.tree.map(lambda a: a[0], run.frames), None)
        writer.append(0, frame, run.statistics)
        monkeypatch.setattr(StagedFile, "commit", committed)
        writer.append(1, frame, run.statistics)
        for thread in threads:
            thread.join()
    for standing, count in told:
        assert f"run.h5 holds {count} frame" in standing


@pytest.mark.thorough
def test_an_interrupt_leaves_complete_frames_and_can_be_resumed(tmp_path, monkeypatch):
    """A frame whose writing was interrupted is not read, and is cut off before the next is appended."""
    path, (scene, particles) = tmp_path / "run.h5", jelly()
    kwargs = {"dt": 5e-3, "save_every": 4}
    single = mpm.simulate(scene, particles, t1=0.07, **kwargs)
    set_count, calls = mpmjax.io._frame_writer.set_count, []

    def interrupted(file, count):
        calls.append(count)
        if count == 3:
            raise KeyboardInterrupt
        set_count(file, count)

    with monkeypatch.context() as patch:
        patch.setattr(mpmjax.io._frame_writer, "set_count", interrupted)
        with pytest.raises(KeyboardInterrupt):
            record(path, scene, particles, t1=0.07, **kwargs)
    assert calls == [1, 2, 3]
    with h5py.File(path, "r+") as file:  # and killed amid the next, before all of it was written
        p = particles.count
        assert file["VTKHDF/Points"].shape == (3 * p, 3)
        file["VTKHDF/Points"].resize(3 * p + 5, axis=0)
    assert_same(load(path).frames, jax.tree.map(lambda a: a[:2], single.frames))
    FrameWriter.resume(path, Problem(scene, prepare(scene, particles), 5e-3, mpm.Explicit())).close()
    with h5py.File(path) as file:
        assert {len(d) for d in file["VTKHDF/PointData"].values()} | {len(file["VTKHDF/Points"])} == {2 * p}
        assert len(file["mpmjax/frames"]) == len(file["VTKHDF/Steps/Values"]) == 2
    record(path, scene, particles, t1=0.07, resume=True, **kwargs)
    assert_same(load(path), single)


@pytest.mark.thorough
def test_a_run_that_blows_up_keeps_its_good_frames(tmp_path):
    """Step, time and particle are named, as `simulate` does; the last good state is the file's last frame."""
    path, (scene, particles) = tmp_path / "run.h5", jelly()
    kwargs = {"dt": 0.1, "save_every": 4}
    with pytest.raises(mpm.SimulationError) as single:
        mpm.simulate(scene, particles, t1=10.0, **kwargs)
    with pytest.raises(mpm.SimulationError, match=r"At step \d+ \(t = .* s\) particle \d+ ") as caught:
        record(path, scene, particles, t1=10.0, **kwargs)
    held = (
        rf" {path} holds \d+ frames, the last of step \d+ \(t = .* s\)\. Resumed it would end there again: begin anew\."
    )
    assert re.fullmatch(re.escape(str(single.value)) + held, str(caught.value))
    run, last = load(path), int(caught.value.run.final_step)
    assert_same((run.final, run.statistics), (caught.value.run.final, caught.value.run.statistics))
    assert_same((run.final, run.statistics), (single.value.run.final, single.value.run.statistics))
    assert last == int(run.statistics.fault_step) - 1
    assert run.steps.tolist() == [*range(0, last, 4), last]
    assert all(np.isfinite(a).all() for a in jax.tree.leaves(run.frames))

    # it is not resumed, since it would end there again
    with pytest.raises(ValueError, match=r"ends with a fault after step \d+ .*: start anew"):
        record(path, scene, particles, t1=10.0, resume=True, **kwargs)

    # a fault in the first step after a frame repeats no frame
    record(path, scene, particles, t1=0.1 * last, overwrite=True, **kwargs)
    with pytest.raises(mpm.SimulationError) as resumed:
        record(path, scene, particles, t1=10.0, resume=True, **kwargs)
    assert str(resumed.value) == str(caught.value)
    assert_same(load(path), run)

    # the run that came with the error can be saved like any other, without what lies beyond its last good state
    save(tmp_path / "single.h5", single.value.run)
    assert_same(load(tmp_path / "single.h5"), run)


@pytest.mark.thorough
def test_a_full_disk_stops_a_run_at_the_frame_that_does_not_fit(tmp_path):
    """At whatever byte that is. The frames before are right, and with room again the run continues as if nothing had
    been; where not even the first frame fits, no file is left."""
    (scene, particles), frames = jelly(), 16
    kwargs = {"t1": frames * 5e-3, "dt": 5e-3, "save_every": 1}
    record(tmp_path / "whole.h5", scene, particles, **kwargs)
    whole, size = load(tmp_path / "whole.h5"), (tmp_path / "whole.h5").stat().st_size
    kept = []
    for number, limit in enumerate([*np.linspace(0.85 * size, size - 1, 4).astype(int), 1000]):
        path = tmp_path / f"{number}.h5"
        with full_beyond(int(limit)), pytest.raises(OSError, match="File too large") as caught:
            record(path, scene, particles, **kwargs)
        assert "\n" not in str(caught.value)
        if not path.exists():
            assert str(caught.value).endswith("It is as it was.")
            continue
        n, last = map(int, re.search(r"holds (\d+) frames?, the last of step (\d+) ", str(caught.value)).groups())
        assert str(caught.value).endswith("Make room, then resume it.")
        part = load(path)
        assert (len(part), part.steps[-1], last) == (n, n - 1, n - 1)
        assert_same(part.frames, jax.tree.map(lambda a, n=n: a[:n], whole.frames))
        kept.append(n)
        record(path, scene, particles, resume=True, **kwargs)
        assert_same(load(path), whole)
    assert kept == sorted(kept)
    assert len(set(kept)) == 4
    assert len(list(tmp_path.iterdir())) == 1 + len(kept)


@pytest.mark.thorough
def test_a_full_disk_leaves_the_run_that_was_to_be_replaced(tmp_path):
    """`save` replaces a file by a whole one or not at all."""
    path, run = tmp_path / "run.h5", made_up(2)
    save(path, run)
    before = path.read_bytes()
    with (
        full_beyond(len(before) // 2),
        pytest.raises(OSError, match=rf"^{path} could not be written: .*File too large"),
    ):
        save(path, run)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_a_full_disk_leaves_the_run_that_was_to_be_recorded_anew(tmp_path):
    """It goes when the first frame of the new one is on the disk; then the new one is continued like any other."""
    path, run, (scene, particles) = tmp_path / "run.h5", made_up(2), jelly()
    kwargs = {"t1": 0.07, "dt": 5e-3, "save_every": 4, "overwrite": True}
    save(path, run)
    size = path.stat().st_size
    for limit in (1000, size // 3):
        with full_beyond(limit), pytest.raises(OSError, match=rf"^{path} could not be written: .*File too large"):
            record(path, scene, particles, **kwargs)
        assert_same(load(path), run)
        assert list(tmp_path.iterdir()) == [path]
    record(path, scene, particles, **kwargs)
    assert load(path).steps.tolist() == [0, 4, 8, 12, 14]


GONE = {
    "removed": lambda path: path.unlink(),
    "moved": lambda path: path.rename(path.with_name("other.h5")),
    "replaced": lambda path: shutil.move(shutil.copy(path.parents[1] / "run.h5", path.with_name("new")), path),
    "folder removed": lambda path: shutil.rmtree(path.parent),
}


@pytest.mark.parametrize("take_away", **ids(GONE, ("removed", "replaced")))
def test_a_run_whose_file_is_taken_away_is_not_called_written(take_away, tmp_path, monkeypatch):
    """At the next frame or, where that was the last, at the end; nor is what stands there now touched."""
    path, (scene, particles) = tmp_path / "folder" / "run.h5", jelly()
    append, reached = FrameWriter.append, []
    save(tmp_path / "run.h5", made_up(2))

    def appended(writer, step, *rest):
        append(writer, step, *rest)
        reached.append(step)
        if reached == until:
            take_away(path)

    monkeypatch.setattr(FrameWriter, "append", appended)
    for until in ([0, 4], [0, 4, 8, 12, 14]):
        path.parent.mkdir(exist_ok=True)
        reached.clear()
        says = r"run\.h5 was removed or replaced while it was written: run the simulation again\.$"
        with pytest.raises(OSError, match=says):
            record(path, scene, particles, t1=0.07, dt=5e-3, save_every=4, overwrite=True)
        assert reached == until
        if path.exists():
            assert_same(load(path), made_up(2))


def test_a_complete_run_can_be_resumed(tmp_path):
    """To its end, or to an earlier time, which it has reached: nothing is done, and its end is returned."""
    path, (scene, particles) = tmp_path / "run.h5", jelly()
    kwargs = {"dt": 5e-3, "save_every": 4}
    whole = record(path, scene, particles, t1=0.07, **kwargs)
    before = path.read_bytes()
    for t1 in (0.07, 0.03):
        again = record(path, scene, particles, t1=t1, resume=True, **kwargs)
        assert_same(again, whole)
    assert path.read_bytes() == before


def test_progress_is_shown_on_standard_error(tmp_path, capsys):
    """And nothing on standard output."""
    scene, particles = jelly()
    record(tmp_path / "run.h5", scene, particles, t1=0.07, dt=5e-3, save_every=4, progress=True)
    out, err = capsys.readouterr()
    assert out == ""
    assert "14/14" in err
    first, *later = err.split("\r")[1:]
    assert first.startswith("compiling:")  # which is not counted in the time left
    assert not any("compiling" in line for line in later)


# What is refused -----------------------------------------------------------------------------------------------------


def test_a_file_that_is_there_is_not_overwritten(tmp_path):
    """Unless asked for."""
    path, (scene, particles) = tmp_path / "run.h5", jelly()
    save(path, made_up(2))
    before = path.read_bytes()
    kwargs = {"dt": 5e-3, "save_every": 4, "t1": 0.06}
    with pytest.raises(ValueError, match=r"run\.h5 exists: .* remove it, or ask to overwrite or to resume it\.$"):
        record(path, scene, particles, **kwargs)
    with pytest.raises(ValueError, match="whole number of steps"):
        record(path, scene, particles, **{**kwargs, "t1": 0.0611}, overwrite=True)
    assert path.read_bytes() == before
    record(path, scene, particles, **kwargs, overwrite=True)
    assert load(path).steps.tolist() == [0, 4, 8, 12]


def test_what_is_no_run_is_not_replaced(tmp_path):
    """Whoever asks; nor is a run that is being written. An empty file has nothing to lose."""
    run, path = made_up(2), tmp_path / "other"
    scene, particles = jelly()
    with h5py.File(tmp_path / "elsewhere.h5", "w") as file:
        file["VTKHDF"] = h5py.ExternalLink("run.h5", "/VTKHDF")
        file["mpmjax"] = h5py.SoftLink("/VTKHDF")
    h5py.File(tmp_path / "bare.h5", "w").close()
    for content in (b"[grid]\n", *(path.read_bytes() for path in tmp_path.glob("*.h5"))):
        path.write_bytes(content)
        with pytest.raises(ValueError, match=r"other is not a run that mpmjax wrote, and is not replaced: "):
            save(path, run)
        with pytest.raises(ValueError, match=r"other is not a run that mpmjax wrote"):
            record(path, scene, particles, t1=0.01, dt=5e-3, save_every=1, overwrite=True)
        assert path.read_bytes() == content
    path.write_bytes(b"")
    save(path, run)
    before = path.read_bytes()
    with FrameWriter.resume(path, problem(run)):
        for attempt in (
            lambda: save(path, run),
            lambda: FrameWriter.create(path, problem(run), overwrite=True),
            lambda: FrameWriter.resume(path, problem(run)),
        ):
            with pytest.raises(ValueError, match=r"other is being written by another run: wait until that ends"):
                attempt()
        assert_same(load(path), run)
    assert path.read_bytes() == before


def other_runs() -> dict:
    """What differs, and what is said of it."""
    run = made_up(2)
    return {
        "law": (
            lambda r: r.scene.material.poisson_ratio,
            0.31,
            r"its scene\.material\.poisson_ratio is 0\.3 instead of 0\.31",
        ),
        "gravity": (lambda r: r.scene.gravity[1], 0.2, r"its scene\.gravity\.1 is 0\.1 instead of 0\.2"),
        "transfer": (lambda r: r.scene.kernel, mpm.BSpline(3), r"its scene\.kernel\.order is 2 instead of 3"),
        "method": (lambda r: r.method, mpm.Explicit(), r"its method\.kind is 'SemiImplicit' instead of 'Explicit'"),
        "dt": (lambda r: r.dt, 2e-3, r"its dt is 0\.001 instead of 0\.002"),
        "mass": (lambda r: r.final.mass, run.final.mass * 2, r"its particles\.mass is another array"),
    }


@pytest.mark.parametrize(("where", "value", "message"), **ids(other_runs()))
def test_another_run_is_not_continued(where, value, message, tmp_path):
    """Scene, method, dt and particles must be the file's; the first difference is named."""
    run = made_up(2)
    save(tmp_path / "run.h5", run)
    before = (tmp_path / "run.h5").read_bytes()
    other = eqx.tree_at(where, run, value)
    with pytest.raises(ValueError, match=message):
        FrameWriter.resume(tmp_path / "run.h5", problem(other))
    assert (tmp_path / "run.h5").read_bytes() == before


def test_a_run_in_another_precision_is_not_continued(tmp_path):
    """Nor one with the other dtype."""
    save(tmp_path / "run.h5", made_up(2))
    run = made_up(2, jnp.float32)
    with pytest.raises(ValueError, match="its dtype is 'float64' instead of 'float32'"):
        FrameWriter.resume(tmp_path / "run.h5", problem(run))


def test_a_law_of_ones_own_cannot_be_saved(tmp_path):
    """The schema does not know it; no file is begun."""

    class Wood(mpm.FixedCorotated):
        """Not the package's own."""

    run = eqx.tree_at(lambda r: r.scene.material, made_up(2), Wood(1e5, 0.3))
    with pytest.raises(ValueError, match=r"^material is a Wood, which files cannot hold"):
        save(tmp_path / "run.h5", run)
    assert not list(tmp_path.iterdir())


def test_batches_and_traced_runs_cannot_be_saved(tmp_path):
    """A file holds one run, with values."""
    run = made_up(2)
    with pytest.raises(ValueError, match="one by one"):
        save(tmp_path / "run.h5", jax.tree.map(lambda a: jnp.stack([a, a]), run))
    with pytest.raises(ValueError, match="inside a jax transformation"):
        jax.jit(lambda r: save(tmp_path / "run.h5", r))(run)


def test_files_of_another_kind_are_named(tmp_path):
    """Missing, a folder, not HDF5, HDF5 of another program, of another format, without frames: one line each."""
    run = made_up(2)

    def of(name: str, message: str) -> None:
        with pytest.raises(ValueError, match=message) as caught:
            load(tmp_path / name)
        assert str(caught.value).startswith(str(tmp_path / name))
        assert "\n" not in str(caught.value)

    of("none.h5", r"does not exist: check its name\.$")
    of("", r"is not a file: name one that mpmjax wrote\.$")
    (tmp_path / "text.h5").write_text("x,y\n1,2\n3,4\n")
    of("text.h5", r"is not an HDF5 file: name one that mpmjax wrote\.$")
    (tmp_path / "empty.h5").write_bytes(b"")
    of("empty.h5", r"is cut short to 0 bytes: restore it from a copy, or run the simulation again\.$")
    h5py.File(tmp_path / "other.h5", "w").close()
    of("other.h5", r"has no group /VTKHDF or /mpmjax: it is not a run that mpmjax wrote\.$")
    save(tmp_path / "later.h5", run)
    with h5py.File(tmp_path / "later.h5", "r+") as file:
        file["mpmjax"].attrs["format"] = 8
    of("later.h5", r"has format 8, this mpmjax reads format 9: use mpmjax [\d.]+, which wrote it\.$")
    save(tmp_path / "bare.h5", run)
    with h5py.File(tmp_path / "bare.h5", "r+") as file:
        file["VTKHDF/Steps"].attrs["NSteps"] = 0
    of("bare.h5", r"holds no frame: run the simulation again\.$")
    save(tmp_path / "lacking.h5", run)
    with h5py.File(tmp_path / "lacking.h5", "r+") as file:
        del file["VTKHDF/PointData/velocity"]
    save(tmp_path / "weightless.h5", run)
    with h5py.File(tmp_path / "weightless.h5", "r+") as file:
        del file["mpmjax/mass"]
    of(
        "weightless.h5",
        r"is damaged \(its scene, method or particles are not what was written\): restore it from a copy, or run",
    )
    of("lacking.h5", r"is damaged \(frame 0 is not what was written\): restore it")
    with pytest.raises(ValueError, match=r"run\.h5 cannot be written \(no folder .*\): name a place that can be\.$"):
        save(tmp_path / "folder" / "run.h5", run)


def replaced(file: h5py.File, name: str, link: object) -> None:
    if name in file:
        del file[name]
    if link is not None:
        file[name] = link


def outside(file: h5py.File, **storage: object) -> None:
    """Put a dataset's numbers elsewhere."""
    numbers = file["VTKHDF/Points"][...]
    del file["VTKHDF/Points"]
    file.create_dataset("VTKHDF/Points", data=numbers, **storage)


LEADING_AWAY = {
    "external link": lambda file, other: replaced(file, "VTKHDF/Points", h5py.ExternalLink(other, "/VTKHDF/Points")),
    "external group": lambda file, other: replaced(file, "VTKHDF", h5py.ExternalLink(other, "/VTKHDF")),
    "soft link": lambda file, _: replaced(file, "VTKHDF/Points", h5py.SoftLink("/VTKHDF/PointData/velocity")),
    "dangling link": lambda file, _: file.update(extra=h5py.SoftLink("/nowhere")),
    "second name": lambda file, _: replaced(file, "VTKHDF/Points", file["VTKHDF/PointData/velocity"]),
    "a group in itself": lambda file, _: file["VTKHDF"].update(VTKHDF=file["VTKHDF"]),
    "external storage": lambda file, other: outside(file, external=[(f"{other}.raw", 0, h5py.h5f.UNLIMITED)]),
    "virtual": lambda file, other: virtual(file, other),
}


def virtual(file: h5py.File, other: str) -> None:
    layout = h5py.VirtualLayout(file["VTKHDF/Points"].shape, file["VTKHDF/Points"].dtype)
    layout[...] = h5py.VirtualSource(other, "VTKHDF/Points", layout.shape)
    del file["VTKHDF/Points"]
    file.create_virtual_dataset("VTKHDF/Points", layout)


@pytest.mark.parametrize("lead_away", **ids(LEADING_AWAY))
def test_a_file_that_leads_elsewhere_is_refused(lead_away, tmp_path):
    """HDF5 would follow, and write there."""
    run, path = made_up(2), tmp_path / "run.h5"
    save(path, run)
    save(tmp_path / "other.h5", run)
    with h5py.File(path, "r+") as file:
        lead_away(file, str(tmp_path / "other.h5"))
    before = {p: p.read_bytes() for p in tmp_path.iterdir()}
    for read in (load, lambda path: FrameWriter.resume(path, problem(run))):
        with pytest.raises(ValueError, match=r"run\.h5: /.*, which no run of mpmjax has: restore it from a copy"):
            read(path)
    assert {p: p.read_bytes() for p in tmp_path.iterdir()} == before


@pytest.mark.parametrize("stored", **ids({"compressed": {}, "uncompressed": {"fletcher32": True}}, "compressed"))
def test_zeros_are_no_data(stored, tmp_path, monkeypatch):
    """Not in any dataset: HDF5's own checksum of zeros is zero. Files were not compressed once."""
    if stored:
        monkeypatch.setattr(mpmjax.io._run_file, "_STORED", stored)
    run, whole, path = made_up(2), tmp_path / "run.h5", tmp_path / "zeros.h5"
    save(whole, run)
    assert_same(load(whole), run)
    says = "not what was written" if stored else "filter returned failure during read"
    chunks = {}

    def add(name, item):
        if isinstance(item, h5py.Dataset) and item.size:
            item.id.chunk_iter(lambda chunk: chunks.update({name: chunk}))

    with h5py.File(whole) as file:
        file.visititems(add)
    tried = 0
    for chunk in chunks.values():
        data, (start, size) = bytearray(whole.read_bytes()), (chunk.byte_offset, chunk.size)
        if not any(data[start : start + size]):
            continue
        tried += 1
        data[start : start + size] = bytes(size)
        path.write_bytes(data)
        for read in (load, lambda path: FrameWriter.resume(path, problem(run))):
            with pytest.raises(ValueError, match=rf"is damaged.* \(.*{says}\)+: restore it"):
                read(path)
    assert tried > 20


def spoilt(name: str, value: object) -> Run:
    """A run with a number that no run has."""
    run = made_up(2)
    frames = lambda r: getattr(r.frames, name)  # noqa: E731
    return eqx.tree_at(frames, run, frames(run).at[1, 3].set(value))


NO_RUNS = {
    "dt": (lambda: eqx.tree_at(lambda r: r.dt, made_up(2), jnp.asarray(jnp.nan)), r"dt \[s\] must be finite"),
    "negative dt": (lambda: eqx.tree_at(lambda r: r.dt, made_up(2), jnp.asarray(-1.0)), r"dt \[s\] must be greater"),
    "x": (lambda: spoilt("x", jnp.nan), r"A run's frames must be finite"),
    "far": (lambda: spoilt("x", 1e30), r"Positions must be below .* m"),
    "v": (lambda: spoilt("v", jnp.inf), r"A run's frames must be finite"),
    "steps": (lambda: eqx.tree_at(lambda r: r.steps, made_up(2), jnp.asarray([5.0, 0, 7])), r"A run's steps must grow"),
}


@pytest.mark.parametrize(("bad", "says"), **ids(NO_RUNS))
def test_what_is_no_run_is_neither_saved_nor_loaded(bad, says, tmp_path, monkeypatch):
    """Numbers that a run cannot have, also where every checksum is right."""
    with pytest.raises(ValueError, match=says):
        save(tmp_path / "run.h5", bad())
    assert not list(tmp_path.iterdir())
    with monkeypatch.context() as patched:
        patched.setattr(mpmjax.io._runs, "_check_numbers", lambda *_: None)
        save(tmp_path / "run.h5", bad())
    with pytest.raises(ValueError, match=rf"run\.h5 is damaged \({says}"):
        load(tmp_path / "run.h5")


LARGE = {
    "mass": lambda file: file["mpmjax/mass"].resize(10**13, axis=0),
    "x": lambda file: file["VTKHDF/Points"].resize(10**13, axis=0),
    "frames": lambda file: file["VTKHDF/Steps"].attrs.modify("NSteps", np.int64(10**13)),
    "no frames": lambda file: file["VTKHDF/Steps"].attrs.modify("NSteps", np.int64(-1)),
    "no chunks": lambda file: replaced(file, "mpmjax/X", None) or file.create_dataset("mpmjax/X", (10**13, 2), float),
    "one chunk": lambda file: (
        replaced(file, "mpmjax/X", None)
        or file.create_dataset("mpmjax/X", (10**5, 5000), float, chunks=(10**5, 5000), compression="gzip")
    ),
    "directions": lambda file: file["mpmjax"].attrs.modify("d", np.int64(10**13)),
    "materials": lambda file: file["mpmjax"].attrs.create("counts", np.array([10**13, 7 - 10**13])),
    "precision": lambda file: file["mpmjax"].attrs.create("dtype", np.bytes_("S1000000000")),
}


@pytest.mark.parametrize("enlarge", **ids(LARGE))
def test_a_file_that_declares_what_it_has_not_is_refused(enlarge, tmp_path):
    """Before memory is taken for it; or what no frame has is left alone."""
    save(tmp_path / "run.h5", made_up(2))
    with h5py.File(tmp_path / "run.h5", "r+", libver=("v110", "v110")) as file:
        enlarge(file)
    if enlarge in (LARGE["x"], LARGE["directions"]):
        assert_same(load(tmp_path / "run.h5"), made_up(2))
        return
    with pytest.raises(ValueError, match=r"run\.h5 is damaged|run\.h5 holds no frame"):
        load(tmp_path / "run.h5")


@pytest.mark.thorough
def test_a_frame_that_was_never_written_is_no_frame(tmp_path):
    """What reads as zeros without a checksum, as after a write that failed, is damage in whatever dataset it is."""
    run, whole = made_up(2), tmp_path / "run.h5"
    save(whole, run)
    with h5py.File(whole) as file:
        names = []
        file.visititems(lambda name, item: names.append(name) if isinstance(item, h5py.Dataset) and item.size else None)
    assert len(names) > 20
    for name in names:
        path = tmp_path / "lost.h5"
        shutil.copy(whole, path)
        with h5py.File(path, "r+", libver=("v110", "v110")) as file:
            length = len(file[name])
            file[name].resize(length - 1, axis=0)
            file[name].resize(length - file[name].chunks[0], axis=0)  # which drops the chunk
            file[name].resize(length, axis=0)
            assert not any(file[name][-1:].tobytes())
        for read in (load, lambda path: FrameWriter.resume(path, problem(run))):
            with pytest.raises(ValueError, match=rf"is damaged \(frame \d of {name} was never written\)"):
                read(path)


def test_what_could_not_be_loaded_is_not_begun(tmp_path):
    """A number that the run's precision rounds to one that the law refuses is named before the run, not after it."""
    scene, particles = jelly(jnp.float32, material=mpm.FixedCorotated(1e4, 0.3))
    for law, says in (
        (
            mpm.FixedCorotated(1e-46, 0.3),
            r"\[material\].*youngs_modulus \[Pa\] must be greater .* got 0\.0",
        ),
        (mpm.FixedCorotated(1e4, 0.5 - 1e-10), r"\[material\].*poisson_ratio must be .* got 0\.5"),
    ):
        bad = dataclasses.replace(scene, material=law)
        with pytest.raises(ValueError, match=rf"run\.h5 could not be loaded again, as float32 rounds it: {says}"):
            record(tmp_path / "run.h5", bad, particles, t1=0.01, dt=5e-3, save_every=1)
    assert not list(tmp_path.iterdir())


def test_float64_runs_are_not_rounded_in_silence(tmp_path):
    """Without 64-bit mode they are read in float32, with a warning."""
    run = made_up(2)
    save(tmp_path / "run.h5", run)
    with jax.enable_x64(False):
        with pytest.warns(UserWarning, match=r"holds a float64 run, read in float32: call jax\.config\.update"):
            rounded = load(tmp_path / "run.h5")
        assert {leaf.dtype for leaf in jax.tree.leaves(rounded.final)} == {np.dtype("float32")}
        np.testing.assert_array_equal(rounded.frames.x, np.asarray(run.frames.x, np.float32))


def test_a_truncated_file_is_refused(tmp_path):
    """At any length, in one line that says what to do."""
    save(tmp_path / "run.h5", made_up(2))
    whole, path = (tmp_path / "run.h5").read_bytes(), tmp_path / "cut.h5"
    for length in (0, 7, 8, 50, 100, 1000, len(whole) // 2, 3 * len(whole) // 4, len(whole) - 100, len(whole) - 1):
        path.write_bytes(whole[:length])
        with pytest.raises(ValueError, match=r"cut\.h5 is cut short.*(restore|run the simulation)") as caught:
            load(path)
        assert "\n" not in str(caught.value)


@pytest.mark.thorough
def test_a_flipped_bit_is_caught_or_harmless(tmp_path):
    """Never does a damaged file load as another run; nor is one continued that has a bad checksum anywhere."""
    run, path = made_up(2), tmp_path / "flipped.h5"
    save(tmp_path / "run.h5", run)
    whole, rng, caught = (tmp_path / "run.h5").read_bytes(), np.random.default_rng(0), []
    with h5py.File(tmp_path / "run.h5") as file:
        chunk = file["VTKHDF/Points"].id.get_chunk_info(1)
    positions = range(8 * chunk.byte_offset + 3, 8 * (chunk.byte_offset + chunk.size), 8 * 24)  # in the second frame
    for bit in [*positions, *rng.integers(0, 8 * len(whole), 120)]:
        damaged = bytearray(whole)
        damaged[bit // 8] ^= 1 << (bit % 8)
        path.write_bytes(damaged)
        try:
            assert_same(load(path), run)
        except ValueError:
            caught.append(bit)
        try:
            with FrameWriter.resume(path, problem(run)) as writer:
                assert_same(writer.last(), (7, RolloutState(state_of(run.final), None), run.statistics))
        except ValueError:
            continue
    assert set(positions) <= set(caught)
    assert len(caught) > 40


def test_no_steps_is_the_row_of_a_start(tmp_path):
    """A recorded run's first frame has the empty statistics."""
    run = made_up(2)
    with FrameWriter.create(tmp_path / "run.h5", problem(run), start=3) as writer:
        step, state, statistics = writer.last()
    assert step == 3
    assert_same((state, statistics), (initial_state(problem(run)), no_steps(jnp.float64)))
