"""`tofcorr.LiveCalibration`: a calibration that grows frame by frame.

A frame is kept as its moments, which hold all that the loss needs, and a lattice of its pixels,
which gives the ranges and the noise: 70 kB in place of 2.5 MB of a VGA image. Its moments are those
of its own ranges; a linear map takes them to the ranges of all frames. So the finished calibration
is that of `tofcorr.train` on the same frames, in any order.

What `add` returns is a fit of the moments alone, on ranges that are a little wider than any frame's
so that they seldom change, and without what the noise moves (`fit.fitting`).
"""

# Long: one class, told in order from a frame to what is known with it.

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
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
from tofcorr.estimation.uncertainty import posterior_covariance, worst_axes
from tofcorr.files import refuse_existing, staged_folder
from tofcorr.fit.fitting import calibrated, estimate, fit
from tofcorr.fit.problem import Fit, Problem
from tofcorr.geometry import se3
from tofcorr.geometry.camera import CameraIntrinsics, DepthKind
from tofcorr.geometry.rays import plane_in_frame, planes_through
from tofcorr.live.frames import (
    FRAME_FORM,
    KeptFrame,
    frame_of,
    is_of_frames,
    mapped,
    of_images,
    suitable,
    values_of_frame,
    wider,
)
from tofcorr.options import resolve_options
from tofcorr.pixels.dataset import Dataset, thread_number
from tofcorr.pixels.lattice import condition_ranges, covered_domain, joined, lattice_in
from tofcorr.pixels.sample import usable_pixels
from tofcorr.training.advice import Workspace, choose_views, draw_pool, predicted_precision
from tofcorr.training.calibration import TrainingOptions
from tofcorr.training.run import Config, calibration_state

_START = "tofcorr-live"
START_FILE = "live.pt"
"""What a folder of a live calibration begins with."""


@dataclass(frozen=True, eq=False)
class Known:
    """How well a calibration is known, and what its newest frame has to do with it.

    Attributes:
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

    def __repr__(self) -> str:
        """Say in two lines what is known, and what is odd."""
        if math.isinf(self.translation_mm + self.rotation_deg):
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
        folder: Where every frame's sums are written as it comes, so that `resume` loses nothing;
            None: they are in memory alone.

    Raises:
        ConfigError: The configuration needs all pixels at once.
        CalibrationDataError: Something is at `folder` already.

    Example:
        live = tofcorr.LiveCalibration(camera, "e0", folder="live")
        known = live.add(depth, None, world_from_tool)
        print(known, known.enough, live.next_pose())
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
        folder: Path | str | None = None,
    ) -> None:
        self.options = suitable(resolve_options(TrainingOptions, config))
        self.wanted_mm, self.wanted_deg = wanted_mm, wanted_deg
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
        self._accumulator: MomentAccumulator | None = None
        # The ranges of what `add` returns, the moments on them, and where its fit stands.
        self._domain: Domain | None = None
        self._sums: dict[int, Tensor] = {}
        self._last: Parameters | None = None
        self._known: Known | None = None
        self._seen: Dataset | None = None
        if self._folder is not None:
            refuse_existing(self._folder)
            start = {"header": self._like.header.to_mapping(), "config": self.options.to_mapping()}
            start |= {"wanted_mm": wanted_mm, "wanted_deg": wanted_deg}
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
            live._known = live._learn(max(live._frames))
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
        return cls(header.recording(folder), **start)

    def take(self, file: Path) -> Known:
        """Take a frame that another process wrote, `frame-*.pt`, and say what is known with it.

        Raises:
            CalibrationDataError: The file is damaged.
        """
        with thread_number(1):
            self._known = self._learn(self._read(file))
        return self._known

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
        fitted = None if self._known is None else self._known.fit
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
            return self._added(number, frame)

    @property
    def _next(self) -> int:
        """Number of the next frame."""
        return max(self._frames, default=-1) + 1

    def _added(self, number: int, frame: KeptFrame) -> Known:
        """Keep a frame, on disk first, and say what is known with it."""
        if self._folder is not None:
            name = self._folder / f"frame-{number:06d}.pt"
            like = {"planes": self._like.planes, "amplitude": self._like.amplitude}
            save_values(
                name, FRAME_FORM, {"like": like, **values_of_frame(frame)}, CalibrationDataError
            )
        self._take(number, frame)
        self._known = self._learn(number)
        return self._known

    def remove(self, frame: int) -> Known | None:
        """Take a frame out again, and say what is known without it; None: it was the only one.

        Raises:
            CalibrationDataError: There is no such frame.
        """
        if frame not in self._frames:
            raise CalibrationDataError(f"There is no frame {frame} to remove.")
        if self._folder is not None:
            (self._folder / f"frame-{frame:06d}.pt").unlink()
        del self._frames[frame], self._sums[frame]
        self._known = self._learn(max(self._frames)) if self._frames else None
        return self._known

    def next_pose(
        self,
        reachable: Callable[[np.ndarray], bool] | None = None,
        space: Workspace | None = None,
        *,
        candidates: int = 300,
        seed: int = 0,
    ) -> np.ndarray | None:
        """Return the pose world_from_tool (4, 4) that would help most; None if none was found.

        Args:
            reachable: Whether the robot reaches a pose (4, 4); None: it reaches every one.
            space: Where the camera may go; None: to the distances and tilts of the frames so far,
                which takes about twice as many poses in the end.
            candidates: How many poses are compared.
            seed: Of the candidates.
        """
        dataset = self._seen
        if self._known is None or self._known.fit is None or dataset is None:
            return None
        found, random = self._known.fit, np.random.default_rng([seed, len(self)])
        lattice, frames = joined([one.lattice for one in self.frames]), np.arange(len(self))
        wanted = [self.wanted_mm / 1e3] * 3 + [math.radians(self.wanted_deg)] * 3
        with thread_number(1):
            pool = draw_pool(
                dataset, frames, found, random, candidates, space, lattice, checkerboard=False
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
        dataset, frames = self._dataset([self._frames[k].row for k in order]), np.arange(len(order))
        lattice = joined([self._frames[k].lattice for k in order])
        domain = covered_domain(dataset, frames, lattice)
        moments = concatenate([self._on(domain, self._frames[k]) for k in order])
        return fit(dataset, frames, self.options, domain, moments=moments, lattice=lattice)

    def state(self) -> CalibrationState:
        """Return the calibration as the numbers that a corrector is built from."""
        rows = [self._frames[k].row for k in self._order()]
        return calibration_state(self._dataset(rows), self.options, self.result())

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
        if self._accumulator is None:
            self._accumulator = MomentAccumulator(Design(model, domain, data.ray_directions()))
        moments = self._accumulator.on(model, domain)(batch)
        if planes == "estimated":
            row = self._on_its_wall(row, moments)
        pose, normal = (torch.from_numpy(x)[None] for x in (row.world_from_tool, row.normal_world))
        offset = torch.tensor([row.offset], dtype=torch.float64)
        normal, offset = plane_in_frame(normal, offset, pose)
        moments = replace(moments, normal_tool=normal, offset_tool=offset)
        return KeptFrame(row, domain, moments, lattice)

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

    def _dataset(self, rows: list[FrameRow]) -> Dataset:
        """Return the frames as a recording whose images were not kept: no pixel has a return."""
        like, size = self._like, (self._like.camera.height, self._like.camera.width)
        nothing = np.broadcast_to(np.float32(np.nan), (len(rows), *size))
        amplitude = None if like.amplitude is None else nothing
        images = {"depth": nothing, "amplitude": amplitude, "mask": None}
        return Dataset((replace(like, frames=FrameTable.of(rows), **images),))

    def _order(self) -> list[int]:
        """Return the frames' numbers in the order of their time stamps."""
        return sorted(self._frames, key=lambda k: (self._frames[k].row.timestamp, k))

    def _on(self, domain: Domain, frame: KeptFrame) -> ImageMoments:
        """Return the moments of a frame with the columns scaled to other ranges."""
        change = columns_on(of_images(self.options.model), domain, frame.domain)
        return replace(frame.moments, gram=mapped(frame.moments.gram, change))

    def _take(self, number: int, frame: KeptFrame) -> None:
        """Add a frame to those that are fitted, on ranges that hold it."""
        before, terms = self._domain, of_images(self.options.model)
        if before is None or before.joined(frame.domain) != before:
            self._domain = wider(frame.domain if before is None else before.joined(frame.domain))
            if before is not None:
                change = columns_on(terms, self._domain, before)
                self._sums = {k: mapped(gram, change) for k, gram in self._sums.items()}
                self._last = None
        assert self._domain is not None
        self._frames[number] = frame
        self._sums[number] = self._on(self._domain, frame).gram

    def _learn(self, number: int) -> Known:
        """Fit the moments of all frames, and say how well the calibration is known."""
        order = self._order()
        rows, here = [self._frames[k].row for k in order], self._domain
        dataset, frames = self._dataset(rows), np.arange(len(order))
        assert here is not None
        poses = len(np.unique(dataset.pose_groups()))
        moments = concatenate([self._frames[k].moments for k in order])
        moments = replace(moments, gram=torch.cat([self._sums[k] for k in order]))
        if any(is_of_frames(term) for term in self.options.model.terms):
            here = replace(here, conditions=condition_ranges(dataset.conditions()))
            self._last = None
        # Where few frames do not determine it, further steps of the solver tell no more.
        few = self.options.solver.model_copy(update={"max_iterations": _MOST_STEPS})
        options = self.options.model_copy(update={"solver": few})
        problem = Problem(dataset, frames, options, here, resumed=self._last)
        try:
            with solvable(self._like.path, "fit"):
                problem, core, covariance = estimate(problem, moments)
        except CalibrationDataError:  # So few frames do not determine it.
            return Known(number, poses)
        assert core.observability is not None
        best = core.solution.parameters
        self._last, self._seen = best, problem.dataset
        found = Fit(
            **vars(core),
            model=calibrated(ErrorModel(core.options, here), best),
            domain=here,
            optimum=best,
            hand_eye_only=best,
            covariance=covariance,
            walls=problem.walls,
        )
        return self._judged(Known(number, poses, fit=found), core.moments, order.index(number))

    def _judged(self, now: Known, moments: ImageMoments, place: int) -> Known:
        """Return the same with intervals, gain and what is odd about one image of the moments."""
        found, before = now.fit, self._known
        assert found is not None
        best = found.optimum
        # Of few poses the scatter between them may be small by chance, but not what they determine.
        expected = posterior_covariance(found.observability.precision)[:6, :6]
        both = zip(worst_axes(found.hand_eye_covariance), worst_axes(expected), strict=True)
        quantile = student_quantile(39 / 40, found.covariance.degrees_of_freedom)
        shift, turn = (quantile * max(pair) for pair in both)
        free = {name for one in found.observability.undetermined for name in one.shares}
        if free & {*HAND_EYE_SYMBOLS}:
            shift = turn = math.inf
            # A fit that starts from anywhere may stay there, whatever further frames say.
            self._last = None
        shift, turn, gained = 1e3 * shift, math.degrees(turn), 0.0
        if before is not None and math.isfinite(shift):
            gained = 1 - max(shift / before.translation_mm, turn / before.rotation_deg)
        spread = 1e3 * found.covariance.matrix.diagonal().clamp(min=0).sqrt()[best.twist_size :]
        return replace(
            now,
            odd=tuple(self._odd(found, moments, place)),
            translation_mm=shift,
            rotation_deg=turn,
            terms_mm=dict(zip(moments.symbols, spread.tolist(), strict=True)),
            weakest=found.directions[0].in_words(),
            gained=gained,
            enough=shift <= self.wanted_mm and turn <= self.wanted_deg,
        )

    def _odd(self, found: Fit, moments: ImageMoments, place: int) -> list[str]:
        """Return what is odd about an image beside the others, a sentence each."""
        before, number, said = self._known, np.arange(len(moments.count)), []

        def is_outlying(sizes: np.ndarray) -> bool:
            return any(one["frame"] == place for one in outlying_images(number, sizes))

        # A wrong frame spoils the fit: it is judged by the one without it.
        known = before is not None and math.isfinite(before.translation_mm)
        if known and len(number) >= _ENOUGH_TO_COMPARE and before and before.fit:
            change = columns_on(found.options, before.fit.domain, found.domain)
            best = before.fit.optimum
            best = replace(best, coefficients=change.T @ best.coefficients)
            # Of each image's plane nothing is known, but for one ray, which shows no tilt.
            ridge = moments.count[:, None, None] * torch.eye(3).double() / 1e9
            within, whole = (
                (MomentObjective(own).image_losses(best).clamp(min=0) / own.count).sqrt().numpy()
                for own in (within_prior(moments, best, ridge), moments)
            )
            noise = np.array([one.noise for one in self.frames])
            # Dark targets have more noise: within an image it is the unit.
            if is_outlying(within / noise):
                said.append(f"shows no plane: {1e3 * within[place]:.1f} mm are left within it.")
            elif is_outlying(whole):
                size = f"{1e3 * whole[place]:.1f} mm"
                said.append(f"disagrees with the others by {size}: pose, plane or time?")
            own, usual = float(moments.count[place]), float(moments.count.median())
            if 2 * own < usual:
                said.append(f"has {own:.0f} usable pixels, where {usual:.0f} are usual.")
        rows = [one.row for one in self.frames][max(place - 1, 0) : place + 1]
        if len(rows) > 1 and rows[1].timestamp - rows[0].timestamp <= _STREAM_S:
            moved = np.abs(rows[1].world_from_tool - rows[0].world_from_tool).max()
            if moved > STANDSTILL:
                said.append("was taken while the robot moved: stand still for each frame.")
        return said


# Steps of the solver for what `add` returns. Chosen: from the last fit it takes three to five.
_MOST_STEPS = 25
# Frames from which on one is compared with the others. Chosen: the spread of fewer is chance.
_ENOUGH_TO_COMPARE = 8
# Time between frames of a stream, seconds: no robot moves and stands still again within it. Chosen.
_STREAM_S = 0.2
