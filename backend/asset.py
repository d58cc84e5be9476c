"""What a job leaves: particles.h5, from the records of the fit and of the forecast, and the result that tells of all files."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from backend import __version__
from backend.contract.cameras import read_cameras
from backend.contract.errors import BackendError
from backend.contract.job import Config
from backend.contract.light import Light
from backend.contract.result import CAMERAS_FILE, PARTICLES_FILE, VDB_FOLDER, Result
from backend.fit import light
from backend.fit.lift import buoyancy_of, wind_of
from backend.fit.lone import drawn_out
from backend.fit.series import Series
from backend.fit.state import PhysicalRecord, VisualRecord, particle_frame
from backend.geometry.camera import view_at
from backend.io.frame_stack import FrameStack
from backend.io.job_folder import JobFolder, fingerprint
from backend.io.particles import Particles, ParticlesInfo, ParticlesWriter, read_particles
from backend.io.records import RecordFile, open_stage_file
from backend.stages import forecast
from backend.stages.export import ExportPlan


@dataclass(frozen=True, slots=True, kw_only=True)
class Asset:
    """Of one job. weights_mark: the fingerprint of the prior's weights; None where it was not asked."""

    folder: JobFolder
    preset: str
    config: Config
    weights_mark: str | None

    def write_particles(self, source: str, visual_mark: str, forecast_mark: str) -> None:
        """particles.h5 from the records of the fit and the forecast; left alone when it follows from them already."""
        mark = fingerprint("particles", None, visual_mark, forecast_mark)
        if _particles_fingerprint(self.folder.particles) == mark:
            return
        with (
            RecordFile(self.folder.physical, PhysicalRecord) as fluid,
            RecordFile(self.folder.visual, VisualRecord) as seen,
            RecordFile(self.folder.forecast, VisualRecord) as ahead,
            ParticlesWriter(self.folder.particles) as writer,
        ):
            cameras = read_cameras(self.folder.cameras)
            for number, record in enumerate(seen):
                writer.append(drawn_out(particle_frame(record), view_at(cameras, number)))
            view = view_at(cameras, len(seen) - 1)
            for record in ahead:
                writer.append(drawn_out(particle_frame(record), view), is_forecast=True)
            last = fluid[len(fluid) - 1]
            buoyancy, doubt = buoyancy_of(last)
            with open_stage_file(self.folder.smoke) as file:
                frame_start = int(file.attrs["frame_start"])  # type: ignore[arg-type]
            info = ParticlesInfo(
                cameras=cameras,
                gravity=(0.0, 0.0, -9.81),
                frame_start=frame_start,
                buoyancy=_triple(buoyancy),
                buoyancy_uncertainty=_triple(doubt),
                fluid={
                    "smoothing_length_m": float(last.smoothing_length),
                    "rest_density": float(last.rest_density),
                    **self._air(last),
                },
                light=self._light(seen),
                provenance={
                    "program": f"wildsmoke {__version__}",
                    "source_fingerprint": source,
                    "preset": self.preset,
                    "settings": asdict(self.config),
                    **({"prior_fingerprint": self.weights_mark} if self.weights_mark else {}),
                    **self._doubt(seen[len(seen) - 1]),
                },
                fingerprint=mark,
            )
            writer.finish(info)

    def _doubt(self, last: VisualRecord) -> dict[str, list[float]]:
        """What the forecast says of its own uncertainty; nothing without one, and the published methods say nothing."""
        config = self.config.forecast
        if config.num_frames == 0 or self.config.method != "default":
            return {}
        seconds = 1.0 / read_cameras(self.folder.cameras).fps
        return {"forecast_deviation_m": forecast.deviations(last, config, seconds=seconds)}

    def result(self, particles: Particles, plan: ExportPlan, mark: str, *, warnings: list[dict[str, str]]) -> Result:
        """What lies in the job's folder once all frames are written."""
        return Result(
            particles=PARTICLES_FILE,
            cameras=CAMERAS_FILE,
            vdb_folder=VDB_FOLDER,
            num_frames=particles.num_frames,
            num_forecast=particles.num_forecast,
            frame_start=particles.info.frame_start,
            fps=particles.info.cameras.fps,
            voxel_size=plan.voxel_size,
            has_color=plan.has_color,
            smoke_color=plan.smoke_color,
            bounds=plan.bounds,
            buoyancy=particles.info.buoyancy,
            background_plate=self.folder.plate.name if self.folder.plate.is_file() else None,
            light=particles.info.light,
            warnings=warnings,
            fingerprint=mark,
        )

    def _air(self, last: PhysicalRecord) -> dict[str, float]:
        """What the air does in the method's fluid: drag, 1/s, everywhere or where smoke borders on air, and the learned wind."""
        if self.config.method != "default":
            return {"surface_drag_per_second": self.config.published.surface_drag}
        drag = self.config.physical.drag
        wind = wind_of(last, drag=drag)
        return {"drag_per_second": drag} | {
            f"wind_{axis}_m_per_second": float(speed) for axis, speed in zip("xyz", wind, strict=True)
        }

    def _light(self, seen: Series[VisualRecord]) -> Light | None:
        """The clip's light, if its smoke shows one in a few frames of all parts of the clip."""
        cameras = read_cameras(self.folder.cameras)
        with open_stage_file(self.folder.smoke) as file:
            layers = FrameStack(file, "smoke")
            numbers = np.unique(np.linspace(len(seen) // 6, len(seen) - 1, light.NUM_FRAMES).astype(int)).tolist()
            shots = []
            for number in numbers:
                layer = layers[number]
                view = view_at(cameras, number, size=(layer.shape[1], layer.shape[0]))
                shots.append(light.Shot(particles=particle_frame(seen[number]), view=view, layer=layer))
        return light.find_light(shots)


def _particles_fingerprint(path: Path) -> str | None:
    """What a particles.h5 follows from; None if there is none or it cannot be read (it is then made anew)."""
    try:
        with read_particles(path) as particles:
            return particles.info.fingerprint
    except BackendError:
        return None


def _triple(values: np.ndarray) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in values)
    return (x, y, z)
