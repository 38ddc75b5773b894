"""`tofcorr.LiveCalibration`: a calibration that grows frame by frame.

A frame is kept as its moments, which hold all that the loss needs, and a lattice of its pixels,
which gives the ranges and the noise: 11 kB for ever, and 64 kB that become fewer beyond 256 frames,
in place of 2.5 MB of a VGA image. A linear map takes moments to other ranges. So the finished
calibration is that of `tofcorr.train` on the same frames, in any order.

What `add` returns is a quick fit of the moments alone (`fit.fitting.fit_of_moments`), on ranges
that are a little wider than any frame's so that they seldom change.
"""

# Long: one class, told in order from a frame to what is known with it.

import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from tofcorr.conditions import CONDITIONS, condition
from tofcorr.correction.corrector import DepthCorrector
from tofcorr.correction.export.torchscript import export_torchscript
from tofcorr.correction.state import (
    STATE_FILE,
    CalibrationState,
    read_values,
    save_calibration,
    save_values,
)
from tofcorr.data.arrays import IMAGE_ARRAYS
from tofcorr.data.recording import STANDSTILL, Header, Recording
from tofcorr.data.table import FrameRow, FrameTable
from tofcorr.error_terms.base import Domain
from tofcorr.error_terms.model import ErrorModel, columns_on
from tofcorr.errors import CalibrationDataError
from tofcorr.estimation.accumulator import Design, MomentAccumulator
from tofcorr.estimation.linear import solvable
from tofcorr.estimation.moments import (
    HAND_EYE_SYMBOLS,
    ImageMoments,
    MomentObjective,
    Parameters,
    concatenate,
)
from tofcorr.estimation.planes import within_prior
from tofcorr.estimation.robust import outlying_images, student_quantile
from tofcorr.estimation.solvers import Solution
from tofcorr.estimation.uncertainty import PRIOR_SIGMA, posterior_covariance, worst_axes
from tofcorr.files import refuse_existing, staged_folder
from tofcorr.fit.fitting import fit, fit_of_moments, with_condition_terms
from tofcorr.fit.problem import Fit, Problem
from tofcorr.fit.walls import recorded_walls
from tofcorr.geometry import se3
from tofcorr.geometry.camera import CameraIntrinsics, DepthKind
from tofcorr.geometry.rays import plane_in_frame, planes_through, ray_directions
from tofcorr.live.frames import (
    FRAME_FORM,
    KeptFrame,
    frame_of,
    is_of_frames,
    mapped,
    nominal_domain,
    of_images,
    suitable,
    values_of_frame,
    wider,
)
from tofcorr.options import resolve_options
from tofcorr.pixels.dataset import Dataset, thread_number
from tofcorr.pixels.lattice import condition_ranges, covered_domain, joined, lattice_in, most_pixels
from tofcorr.pixels.sample import usable_pixels
from tofcorr.training.advice import Workspace, choose_views, draw_pool, predicted_precision
from tofcorr.training.calibration import TrainingOptions
from tofcorr.training.run import Config, calibration_state

_START, _FILE = "tofcorr-live", "frame-{:06d}.pt"
START_FILE = "live.pt"
"""What a folder of a live calibration begins with."""


@dataclass(frozen=True, eq=False)
class Known:
    """How well a calibration is known, and what its newest frame has to do with it.

    Attributes:
        next_pose: Chooses the next pose, as `LiveCalibration.next_pose`.
        frame: Number of the newest frame, by which `remove` takes it out.
        poses: How many poses there are.
        odd: What is odd about the newest frame, a sentence each.
        translation_mm: Half the 95 % interval of the hand-eye transform along its worst axis, mm;
            infinite while it is not determined.
        rotation_deg: The same of the rotation, degrees.
        terms_mm: Standard error of each coefficient of the scaled variables, mm.
        weakest: The direction known least, in words.
        gained: By how much the newest frame has shrunk the wider of both intervals, a share of it.
        enough: Whether both intervals are as narrow as wanted.
        fit: The fit of the moments; None of fewer than three poses.
    """

    next_pose: Callable[..., np.ndarray | None]
    frame: int
    poses: int
    odd: tuple[str, ...] = ()
    translation_mm: float = math.inf
    rotation_deg: float = math.inf
    terms_mm: Mapping[str, float] | None = None
    weakest: str = ""
    gained: float = 0.0
    enough: bool = False
    fit: Fit | None = None

    @property
    def is_determined(self) -> bool:
        """Whether the frames determine the hand-eye transform to 100 mm and 100 mrad at least."""
        return math.isfinite(self.translation_mm + self.rotation_deg)

    def __repr__(self) -> str:
        """Say in two lines what is known, and what is odd."""
        if not self.is_determined:
            known = f"{self.poses} poses: the hand-eye transform is not determined yet"
        else:
            size = f"{self.translation_mm:.2f} mm and {self.rotation_deg:.3f} degrees"
            known = f"{self.poses} poses: the hand-eye transform is known to {size}"
        said = f"{known}{', which is enough' if self.enough else ''}."
        return "\n".join([said, *(f"Frame {self.frame} {one}" for one in self.odd)])


class LiveCalibration:
    """Calibrates a camera while it records; the frames need not be kept.

    Args:
        camera: The intrinsics; or a recording whose camera, units and start are taken.
        config: As of `tofcorr.train`; terms whose functions depend on the range (splines), a
            fixed pattern, networks, and robust or noise weights need all pixels at once.
        tool_from_camera: A guess of the hand-eye transform, shape (4, 4); None: the identity.
        depth_kind: `radial`: along the viewing ray; `z`: along the optical axis.
        modulation_frequency: Hz; None if unknown.
        saturation_amplitude: Pixels at or above it are not used; None if unknown.
        wanted_mm: Half the 95 % interval of the translation that is enough, along its worst axis.
        wanted_deg: The same of the rotation, degrees.
        space: Where the camera may go, turned by `roll_deg` from the frames; None: to the distances
            and tilts of the frames so far, which takes about twice as many poses in the end.
        folder: Where every frame's sums are written as it comes, so that `resume` loses nothing;
            None: they are in memory alone.

    Raises:
        ConfigError: The configuration needs all pixels at once.
        CalibrationDataError: Something is at `folder` already.

    Example:
        live = tofcorr.LiveCalibration(camera, "e0", folder="live")
        known = live.add(depth, None, world_from_tool)
        print(known, known.enough, known.next_pose())
    """

    def __init__(  # noqa: PLR0913 - a camera has many numbers
        self,
        camera: CameraIntrinsics | Recording,
        config: Config = "ea",
        *,
        tool_from_camera: np.ndarray | None = None,
        depth_kind: DepthKind = "radial",
        modulation_frequency: float | None = None,
        saturation_amplitude: float | None = None,
        wanted_mm: float = 0.5,
        wanted_deg: float = 0.05,
        space: Workspace | None = None,
        folder: Path | str | None = None,
    ) -> None:
        self.options = suitable(resolve_options(TrainingOptions, config))
        self.wanted_mm, self.wanted_deg, self.space = wanted_mm, wanted_deg, space
        self._folder = None if folder is None else Path(folder)
        if isinstance(camera, Recording):
            self._like = camera
        else:
            guess = np.eye(4) if tool_from_camera is None else np.asarray(tool_from_camera, float)
            self._like = Recording(
                path=self._folder or Path("live calibration"),
                camera=camera,
                depth_kind=depth_kind,
                modulation_frequency=modulation_frequency,
                saturation_amplitude=saturation_amplitude,
                tool_from_camera=se3.nearest_rigid(guess),
            )
        self._frames: dict[int, KeptFrame] = {}
        # What the ranges are is not part of what it holds.
        camera, terms = self._like.camera, of_images(self.options.model)
        domain = nominal_domain(camera.height, camera.width)
        design = Design(ErrorModel(terms, domain), domain, ray_directions(camera))
        self._accumulator = MomentAccumulator(design)
        # The ranges that scale the moments of all frames.
        self._domain: Domain | None = None
        # The last fit, of how many frames, and the planes of the walls that it found.
        self._known: Known | None = None
        self._fitted = 0
        self._planes: dict[str, dict[str, Any]] = {}
        if self._folder is not None:
            refuse_existing(self._folder)
            start = {"header": self._like.header.to_mapping(), "config": self.options.to_mapping()}
            start |= {"wanted_mm": wanted_mm, "wanted_deg": wanted_deg}
            start |= {"space": space and asdict(space)}
            with staged_folder(self._folder) as staged:
                save_values(staged / START_FILE, _START, start, CalibrationDataError)

    @classmethod
    def resume(cls, folder: Path | str) -> "LiveCalibration":
        """Return the calibration that a folder holds, with every frame that was added.

        Raises:
            CalibrationDataError: The folder holds none, or a frame of it is damaged.
        """
        live, folder = cls.started(folder), Path(folder)
        live._folder = folder
        for file in sorted(folder.glob("frame-*.pt")):
            live._read(file)
        if live._frames:
            live._learn(max(live._frames))
        return live

    @classmethod
    def started(cls, folder: Path | str) -> "LiveCalibration":
        """Return the calibration that a folder holds without its frames, which `take` adds.

        Raises:
            CalibrationDataError: The folder holds none.
        """
        folder = Path(folder)
        start = read_values(folder / START_FILE, _START)
        if start is None:
            raise CalibrationDataError(f"{folder}: holds no live calibration ({START_FILE}).")
        where = str(folder / START_FILE)
        header = Header.from_mapping(start.pop("header"), where, CalibrationDataError)
        space = start.pop("space")
        return cls(header.recording(folder), space=space and Workspace(**space), **start)

    def take(self, file: Path) -> Known:
        """Take a frame that another process wrote, `frame-*.pt`, and say what is known with it.

        Raises:
            CalibrationDataError: The file is damaged.
        """
        with thread_number(1):
            return self._taught(self._read(file))

    def _read(self, file: Path) -> int:
        """Add the frame of a file to those that are fitted, and return its number."""
        values = read_values(file, FRAME_FORM)
        if values is None:
            raise CalibrationDataError(f"{file}: is damaged; remove it to go on without it.")
        self._like = replace(self._like, **values.pop("like"))
        number = int(file.stem.removeprefix("frame-"))
        self._take(number, frame_of(values))
        return number

    @property
    def camera(self) -> CameraIntrinsics:
        """The intrinsics."""
        return self._like.camera

    @property
    def frames(self) -> list[KeptFrame]:
        """What is kept of the frames, in the order of their time stamps."""
        return [self._frames[k] for k in self._order()]

    @property
    def tool_from_camera(self) -> np.ndarray:
        """The hand-eye transform as far as it is known, shape (4, 4)."""
        fitted = None if self._known is None or not self._known.is_determined else self._known.fit
        guess = self._like.tool_from_camera
        return guess if fitted is None else fitted.optimum.tool_from_camera.numpy()

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self._frames)

    @property
    def known(self) -> Known | None:
        """How well the calibration is known now; None before the first frame."""
        return self._known

    def add(
        self,
        depth: np.ndarray | Tensor,
        amplitude: np.ndarray | Tensor | None,
        world_from_tool: np.ndarray,
        *,
        plane: np.ndarray | None = None,
        target: str = "wall",
        mask: np.ndarray | Tensor | None = None,
        timestamp: float | None = None,
        pose_id: str | None = None,
        **conditions: float,
    ) -> Known:
        """Take a frame, and say what is known with it.

        Args:
            depth: Shape (H, W), metres; NaN or <= 0: no return.
            amplitude: The camera's units, shape (H, W); None if the camera has none.
            world_from_tool: Pose of the robot's tool, shape (4, 4).
            plane: The wall (nx, ny, nz, d), n . x + d = 0 in the world; None: it is estimated, as
                one wall for all frames of one target.
            target: Name of the wall.
            mask: 1 where the pixel sees the wall, shape (H, W); None: everywhere.
            timestamp: Seconds; orders the frames. None: the number of the frame.
            pose_id: Frames with the same id were taken without moving.
            conditions: By column of frames.csv, such as `integration_time_us`.

        Raises:
            CalibrationDataError: Shape or values are not allowed, no pixel is usable, or earlier
                frames had amplitudes, planes or conditions and this has not, or the reverse.
        """
        columns = {condition(name).column: condition(name) for name in CONDITIONS[1:]}
        if unknown := conditions.keys() - columns.keys():
            said = f"{', '.join(sorted(unknown))}: no condition. Known: {', '.join(columns)}."
            raise CalibrationDataError(said)
        at = np.array([0.0, 0.0, -1.0, 0.0] if plane is None else plane, dtype=np.float64)
        at /= np.linalg.norm(at[:3])
        row = FrameRow(
            timestamp=float(self._next if timestamp is None else timestamp),
            world_from_tool=se3.nearest_rigid(np.asarray(world_from_tool, dtype=np.float64)),
            normal_world=at[:3],
            offset=float(at[3]),
            target=target,
            pose_id=pose_id,
            **{columns[k].name: x * columns[k].si_per_unit for k, x in conditions.items()},
        )
        return self.add_frame(row, depth, amplitude, mask, plane_is_known=plane is not None)

    def add_frame(
        self,
        row: FrameRow,
        depth: np.ndarray | Tensor,
        amplitude: np.ndarray | Tensor | None = None,
        mask: np.ndarray | Tensor | None = None,
        *,
        plane_is_known: bool,
    ) -> Known:
        """Take a frame with its row of `frames.csv`, as `add` does.

        Args:
            row: What is known of it besides its images.
            depth: As of `add`.
            amplitude: As of `add`.
            mask: As of `add`.
            plane_is_known: Whether the plane of the row was measured; else it is estimated.

        Raises:
            CalibrationDataError: As of `add`.
        """
        number = self._next
        images = self._images(number, depth=depth, amplitude=amplitude, mask=mask)
        with thread_number(1):  # Threads would wait longer than they compute.
            frame = self._summed(row, images, "recorded" if plane_is_known else "estimated")
            if self._folder is not None:
                like = {"planes": self._like.planes, "amplitude": self._like.amplitude}
                file, values = self._folder / _FILE.format(number), values_of_frame(frame)
                save_values(file, FRAME_FORM, {"like": like, **values}, CalibrationDataError)
            self._take(number, frame)
            return self._taught(number)

    @property
    def _next(self) -> int:
        """Number of the next frame."""
        return max(self._frames, default=-1) + 1

    def remove(self, frame: int) -> Known | None:
        """Take a frame out again, and say what is known without it; None: it was the only one.

        Raises:
            CalibrationDataError: There is no such frame.
        """
        if frame not in self._frames:
            raise CalibrationDataError(f"There is no frame {frame} to remove.")
        if self._folder is not None:
            (self._folder / _FILE.format(frame)).unlink()
        del self._frames[frame]
        self._known = self._learn(max(self._frames)) if self._frames else None
        return self._known

    def next_pose(
        self,
        reachable: Callable[[np.ndarray], bool] | None = None,
        *,
        candidates: int = 300,
        seed: int = 0,
    ) -> np.ndarray | None:
        """Return the pose world_from_tool (4, 4) that would help most; None if none was found.

        Args:
            reachable: Whether the robot reaches a pose (4, 4); None: it reaches every one.
            candidates: How many poses are compared.
            seed: Of the candidates.
        """
        if self._known is None or self._known.fit is None:
            return None
        found, random = self._known.fit, np.random.default_rng([seed, len(self)])
        lattice, frames = joined([one.lattice for one in self.frames]), np.arange(len(self))
        dataset = self._dataset(self._order())
        if not self._known.is_determined:
            # Where the fit stands says nothing yet: the guess does.
            guess = torch.from_numpy(self.tool_from_camera)
            zero = torch.zeros_like(found.optimum.coefficients)
            best = replace(found.optimum, tool_from_camera=guess, coefficients=zero)
            found = replace(found, optimum=best, solution=Solution(best))
            if found.walls is not None:
                walls = recorded_walls(dataset, frames)
                found = replace(found, walls=walls, moments=walls.walls.seen_by(found.moments))
        wanted = [self.wanted_mm / 1e3] * 3 + [math.radians(self.wanted_deg)] * 3
        with thread_number(1):
            pool = draw_pool(
                dataset, frames, found, random, candidates, self.space, lattice, checkerboard=False
            )
            if pool is not None and reachable is not None:
                reached = [reachable(pose) for pose in pool.world_from_tool.numpy()]
                pool = pool.only(np.flatnonzero(reached)) if any(reached) else None
            if pool is None:
                return None
            # Views are smooth: so many pixels tell what all would.
            precision, added = predicted_precision(pool, found, dataset, enough=500)
            (best,), _ = choose_views(precision, added, 1, torch.tensor(wanted).double())
        return pool.world_from_tool[best].numpy()

    def result(self) -> Fit:
        """Return the calibration of all frames, as `tofcorr.train` finds it.

        Raises:
            CalibrationDataError: The frames do not determine it.
        """
        order = self._order()
        dataset, frames = self._dataset(order, found=False), np.arange(len(order))
        lattice = joined([self._frames[k].lattice for k in order])
        domain, moments = covered_domain(dataset, frames, lattice), self._moments(dataset, order)
        assert self._domain is not None
        change = columns_on(of_images(self.options.model), domain, self._domain)
        moments = replace(moments, gram=mapped(moments.gram, change))
        return fit(dataset, frames, self.options, domain, moments=moments, lattice=lattice)

    def state(self) -> CalibrationState:
        """Return the calibration as the numbers that a corrector is built from."""
        return calibration_state(self._dataset(self._order()), self.options, self.result())

    def save(self, folder: Path | str) -> None:
        """Write `state.pt` and `corrector.ts` into a new folder, whole or not at all.

        Raises:
            CalibrationDataError: The frames do not determine the calibration, or the folder cannot
                be written.
        """
        state = self.state()
        with staged_folder(folder) as staged:
            save_calibration(staged / STATE_FILE, state)
            export_torchscript(DepthCorrector.from_state(state), staged / "corrector.ts", state)

    def _images(self, number: int, **given: Any) -> dict[str, np.ndarray | None]:  # noqa: ANN401
        """Return the images of one frame (1, H, W) as the recording format has them."""
        size, images = (self._like.camera.height, self._like.camera.width), {}
        for name, image in given.items():
            images[name] = None
            if image is not None:
                kind = IMAGE_ARRAYS[name]
                images[name] = np.array(image, dtype=kind.dtype)[None]
                if images[name].shape[1:] != size:
                    got = f"got {images[name].shape[1:]}"
                    raise CalibrationDataError(f"{name}: expected shape {size}, {got}.")
                kind.check(images[name], [number], self._like.path)
        return images

    def _summed(
        self,
        row: FrameRow,
        images: Mapping[str, np.ndarray | None],
        planes: Literal["estimated", "recorded"],
    ) -> KeptFrame:
        """Return what is kept of a frame."""
        before = self._like.planes, self._like.amplitude is None
        if self._frames and before != (planes, images["amplitude"] is None):
            said = "give amplitude and plane with every frame, or with none"
            raise CalibrationDataError(f"This frame differs from those before: {said}.")
        known: Any = None if images["amplitude"] is None else True  # The image itself is not kept.
        self._like = replace(self._like, planes=planes, amplitude=known)
        data = usable_pixels(
            Dataset((replace(self._like, frames=FrameTable.of([row]), **images),)),
            self.options,
            robust=False,
        )
        # Radial distances were recorded in float32, which holds them without loss.
        exact = self._like.depth_kind == "radial" and data.exclude is None
        dtype = torch.float32 if exact else torch.float64
        batch = next(data.batches(image_dtype=dtype))
        lattice = lattice_in(batch, data.ray_directions())
        # What is known of the frames scales the condition terms, which the sums do not hold.
        domain = replace(covered_domain(data, [0], lattice), conditions={})
        model = ErrorModel(of_images(self.options.model), domain)
        moments = self._accumulator.on(model, domain)(batch)
        if planes == "estimated":
            row = self._on_its_wall(row, moments)
        return KeptFrame.of(row, domain, moments, lattice)

    def _on_its_wall(self, row: FrameRow, moments: ImageMoments) -> FrameRow:
        """Return the row with the plane where its target's wall starts: that of its first frame."""
        for one in self._frames.values():
            if one.row.target == row.target:
                return replace(row, normal_world=one.row.normal_world, offset=one.row.offset)
        # The points' entries of the columns: x, y, z and 1.
        points = moments.gram[0, [0, 1, 2, -1]][:, [0, 1, 2, -1]]
        plane = planes_through(points, torch.zeros(3, dtype=torch.float64))
        camera = torch.from_numpy(row.world_from_tool @ self._like.tool_from_camera)
        normal, offset = plane_in_frame(*plane, se3.inverse(camera))
        return replace(row, normal_world=normal.numpy(), offset=float(offset))

    def _dataset(self, numbers: list[int], *, found: bool = True) -> Dataset:
        """Return frames as a recording whose images were not kept: no pixel has a return.

        Args:
            numbers: Those of the frames.
            found: Whether walls are where the last fit found them; else where they start.
        """
        planes = self._planes if found else {}
        rows = [self._frames[k].row for k in numbers]
        table = FrameTable.of([replace(one, **planes.get(one.target, {})) for one in rows])
        like, size = self._like, (self._like.camera.height, self._like.camera.width)
        nothing = np.broadcast_to(np.float32(np.nan), (len(rows), *size))
        amplitude = None if like.amplitude is None else nothing
        return Dataset(
            (replace(like, frames=table, depth=nothing, amplitude=amplitude, mask=None),)
        )

    def _moments(self, dataset: Dataset, numbers: list[int]) -> ImageMoments:
        """Return the moments of frames, which see the planes of their data set."""
        columns = "normal_world", "offset", "world_from_tool"
        normal, offset = plane_in_frame(*(dataset.column(name) for name in columns))
        moments = concatenate([self._frames[k].moments for k in numbers])
        return replace(moments, normal_tool=normal, offset_tool=offset)

    def _order(self) -> list[int]:
        """Return the frames' numbers in the order of their time stamps."""
        return sorted(self._frames, key=lambda k: (self._frames[k].row.timestamp, k))

    def _take(self, number: int, frame: KeptFrame) -> None:
        """Add a frame to those that are fitted, on ranges that hold it."""
        before, terms = self._domain, of_images(self.options.model)
        if before is None or before.joined(frame.domain) != before:
            here = wider(frame.domain if before is None else before.joined(frame.domain))
            if self._frames and before is not None:
                change = columns_on(terms, here, before)
                self._frames = {k: one.on(here, change) for k, one in self._frames.items()}
            self._domain = here
        assert self._domain is not None
        change = columns_on(terms, self._domain, frame.domain)
        self._frames[number] = frame.on(self._domain, change)
        count = len(self._frames)
        fewer = most_pixels(count) < most_pixels(count - 1)
        for k in self._frames if fewer else [number]:
            one = self._frames[k]
            self._frames[k] = replace(one, lattice=one.lattice.thinned(count))

    def _taught(self, number: int) -> Known:
        """Say what is odd about a new frame, and what is known with it."""
        odd, further = tuple(self._odd(number)), len(self._frames) - self._fitted
        if self._known is not None and further < _ONE_OF * len(self._frames):
            self._known = replace(self._known, frame=number, odd=odd, gained=0.0)
        else:
            self._known = replace(self._learn(number), odd=odd)
        return self._known

    def _learn(self, number: int) -> Known:
        """Fit the moments of all frames, and say how well the calibration is known."""
        order, before = self._order(), self._known
        dataset, frames = self._dataset(order), np.arange(len(order))
        assert self._domain is not None
        here = self._domain
        if any(is_of_frames(term) for term in self.options.model.terms):
            here = replace(here, conditions=condition_ranges(dataset.conditions()))
        problem = Problem(dataset, frames, self.options, here, resumed=self._last_on(here))
        self._fitted, self._planes = len(order), {}
        self._known = Known(self.next_pose, number, int(problem.poses().max()) + 1)
        try:
            with solvable(self._like.path, "fit"):
                moments = self._moments(dataset, order)
                found = fit_of_moments(problem, moments, _MOST_STEPS)
        except CalibrationDataError:  # So few frames do not determine it.
            return self._known
        self._known = self._judged(replace(self._known, fit=found), before)
        if found.walls is not None and self._known.is_determined:
            walls, names = found.walls.walls, [found.walls.names[k] for k in found.walls.numbers]
            both = zip(names, walls.normal_world.numpy(), walls.offset.tolist(), strict=True)
            self._planes = {name: {"normal_world": n, "offset": d} for name, n, d in both}
        return self._known

    def _last_on(self, domain: Domain) -> Parameters | None:
        """Return where the last fit stands, for some ranges; None: it was not determined.

        A fit that starts from anywhere may stay there, whatever further frames say.
        """
        last = None if self._known is None or not self._known.is_determined else self._known.fit
        if last is None or last.domain == domain:
            return last and last.optimum
        change = columns_on(last.options, last.domain, domain)
        return replace(last.optimum, coefficients=change.T @ last.optimum.coefficients)

    def _judged(self, now: Known, before: Known | None) -> Known:
        """Return the same with intervals, and what they gained on those before."""
        found = now.fit
        assert found is not None
        # Of few poses the scatter between them may be small by chance, but not what they determine.
        expected = posterior_covariance(found.observability.precision)[:6, :6]
        both = zip(worst_axes(found.hand_eye_covariance), worst_axes(expected), strict=True)
        quantile = student_quantile(39 / 40, found.covariance.degrees_of_freedom)
        shift, turn = (quantile * max(pair) for pair in both)
        free = {name for one in found.observability.undetermined for name in one.shares}
        # No less is known of a mount that nobody has measured.
        if free & {*HAND_EYE_SYMBOLS} or max(shift, turn) > PRIOR_SIGMA:
            shift = turn = math.inf
        shift, turn, gained = 1e3 * shift, math.degrees(turn), 0.0
        if before is not None and math.isfinite(shift):
            gained = 1 - max(shift / before.translation_mm, turn / before.rotation_deg)
        spread = found.covariance.matrix.diagonal().clamp(min=0).sqrt()[found.optimum.twist_size :]
        return replace(
            now,
            translation_mm=shift,
            rotation_deg=turn,
            terms_mm=dict(zip(found.moments.symbols, (1e3 * spread).tolist(), strict=True)),
            weakest=found.directions[0].in_words(),
            gained=gained,
            enough=shift <= self.wanted_mm and turn <= self.wanted_deg,
        )

    def _odd(self, number: int) -> list[str]:
        """Return what is odd about a frame, a sentence each."""
        row, others = self._frames[number].row, [k for k in sorted(self._frames) if k != number]
        said = self._apart([*others[-_MOST_COMPARED:], number])
        earlier = [one for k in others if (one := self._frames[k].row).timestamp <= row.timestamp]
        last = max(earlier, key=lambda one: one.timestamp, default=row)
        moved = np.abs(row.world_from_tool - last.world_from_tool).max()
        if row.timestamp - last.timestamp <= _STREAM_S and moved > STANDSTILL:
            said.append("was taken while the robot moved: stand still for each frame.")
        return said

    def _apart(self, numbers: list[int]) -> list[str]:
        """Return what sets the last of some frames apart from the others, a sentence each."""
        # A wrong frame spoils the fit: it is judged by the one without it.
        last, here = None if self._known is None else self._known.fit, self._domain
        if last is None or here is None or len(numbers) < _ENOUGH_TO_COMPARE:
            return []
        here = replace(here, conditions=last.domain.conditions)
        best = self._last_on(here)
        if best is None:
            return []
        dataset, model = self._dataset(numbers), ErrorModel(last.options, here)
        moments = self._moments(dataset, numbers)
        moments = with_condition_terms(model, moments, dataset.conditions())
        # Of each image's plane nothing is known, but for one ray, which shows no tilt.
        ridge = moments.count[:, None, None] * torch.eye(3).double() / 1e9
        within, whole = (
            (MomentObjective(own).image_losses(best).clamp(min=0) / own.count).sqrt().numpy()
            for own in (within_prior(moments, best, ridge), moments)
        )
        every, said = np.arange(len(numbers)), list[str]()

        def is_outlying(sizes: np.ndarray) -> bool:
            return any(one["frame"] == every[-1] for one in outlying_images(every, sizes))

        # Dark targets have more noise: within an image it is the unit.
        if is_outlying(within / np.array([self._frames[k].noise for k in numbers])):
            said.append(f"shows no plane: {1e3 * within[-1]:.1f} mm are left within it.")
        elif is_outlying(whole):
            size = f"{1e3 * whole[-1]:.1f} mm"
            said.append(f"disagrees with the others by {size}: pose, plane or time?")
        own, usual = float(moments.count[-1]), float(moments.count.median())
        if 2 * own < usual:
            said.append(f"has {own:.0f} usable pixels, where {usual:.0f} are usual.")
        return said


# Steps of the solver for what `add` returns. Chosen: from the last fit it takes three to five.
_MOST_STEPS = 25
# Frames from which on one is compared with the others, and the most of these, the newest. Chosen:
# the spread of fewer is chance (of eight, a clean one was called odd), and more tell no more.
_ENOUGH_TO_COMPARE, _MOST_COMPARED = 12, 99
# Share of the frames that are new before they are fitted once more. Chosen: an interval shrinks by
# a quarter of a percent with them, and what a frame costs does not grow with their number.
_ONE_OF = 1 / 200
# Time between frames of a stream, seconds: no robot moves and stands still again within it. Chosen.
_STREAM_S = 0.2
