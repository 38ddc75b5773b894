"""`tofcorr.LiveCalibration`: a calibration that grows frame by frame.

A frame is kept as its moments, which hold all that the loss needs, and a lattice of its pixels,
which gives the ranges and the noise: some 10 and 64 kB in place of 2.5 MB of a VGA image. Flying
pixels and second bounces are found in whole images: these are then kept as well. A linear map takes
moments to other ranges. So the finished calibration is that of `tofcorr.train` on the
same frames, in any order.

What `add` returns is a quick fit of the moments alone (`fit.fitting.fit_of_moments`), on ranges
that are a little wider than any frame's so that they seldom change. Of many frames it takes some,
evenly spread over the recording, and expects of all what their number makes of it. The others may
stay on disk: neither time nor memory of `add` then grows with the number of frames.
"""

# Long: one class, told in order from a frame to what is known with it.

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
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
from tofcorr.fit.walls import lone_walls, recorded_walls
from tofcorr.geometry import se3
from tofcorr.geometry.camera import CameraIntrinsics, DepthKind
from tofcorr.geometry.rays import plane_in_frame, planes_through, ray_directions
from tofcorr.live.frames import (
    FRAME_FORM,
    KeptFrame,
    Sums,
    frame_of,
    is_of_frames,
    mapped,
    of_images,
    suitable,
    values_of_frame,
    wider,
)
from tofcorr.options import resolve_options
from tofcorr.pixels.dataset import Dataset, SplitOptions, thread_number
from tofcorr.pixels.lattice import (
    condition_ranges,
    covered_domain,
    joined,
    lattice_in,
    most_pixels,
    scattered,
)
from tofcorr.pixels.sample import usable_pixels
from tofcorr.training.advice import (
    Workspace,
    choose_views,
    domain_of_views,
    draw_pool,
    predicted_precision,
)
from tofcorr.training.calibration import Calibration, TrainingOptions
from tofcorr.training.run import Config, calibration_of, calibration_state
from tofcorr.training.scene import with_remainder

_START = "tofcorr-live"
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
            infinite while it is not determined, or not estimated.
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
        folder: Where every frame's sums are written as it comes, so that `resume` loses nothing and
            memory does not grow; None: all are in memory.

    Attributes:
        options: Those of the fit.
        camera: The intrinsics.
        known: How well the calibration is known now; None before the first frame.

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
        # Of the frames that `add` looks at; without a folder of all.
        self._sums: dict[int, Sums] = {}
        # The ranges that scale them: any before the first frame.
        self.camera = self._like.camera
        self._domain = domain_of_views(self.camera, Workspace(nearest=1.0, farthest=2.0))
        self.options = suitable(resolve_options(TrainingOptions, config), self._domain)
        runtime, self._terms = self.options.runtime, of_images(self.options.model)
        self._keeps_images = runtime.flying_pixels is not None or runtime.second_bounces is not None
        model = ErrorModel(self._terms, self._domain)
        design = Design(model, self._domain, ray_directions(self.camera))
        self._accumulator = MomentAccumulator(design)
        # The last fit, of how many frames, and the planes of the walls that it found.
        self.known: Known | None = None
        self._fitted = 0
        self._planes: dict[str, tuple[np.ndarray, float]] = {}
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
        live = cls.started(folder)
        for file in sorted(Path(folder).glob("frame-*.pt")):
            live._include(file)
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
        live = cls(header.recording(folder), space=space and Workspace(**space), **start)
        live._folder = folder
        return live

    def take(self, file: Path) -> Known:
        """Take a frame that another process wrote, `frame-*.pt`, and say what is known with it.

        Raises:
            CalibrationDataError: The file is damaged.
        """
        with thread_number(1):
            return self._taught(self._include(file))

    def _include(self, file: Path) -> int:
        """Add the frame of a file to those that are fitted, and return its number."""
        like, row, sums = self._read(file)
        self._like = replace(self._like, **like)
        self._widen(sums.domain)
        number = int(file.stem.removeprefix("frame-"))
        self._take(number, row, sums.on(self._domain, self._terms))
        return number

    def _read(self, file: Path) -> tuple[dict[str, Any], FrameRow, Sums]:
        """Return what the file of a frame says of all frames, its row, and its sums."""
        values = read_values(file, FRAME_FORM)
        if values is None:
            raise CalibrationDataError(f"{file}: is damaged; remove it to go on without it.")
        return values.pop("like"), *frame_of(values)

    @property
    def frames(self) -> list[KeptFrame]:
        """What is kept of the frames, in the order of their time stamps."""
        return [self._frames[k] for k in self._order()]

    @property
    def tool_from_camera(self) -> np.ndarray:
        """The hand-eye transform as far as it is known, shape (4, 4)."""
        fitted = None if self.known is None or not self.known.is_determined else self.known.fit
        guess = self._like.tool_from_camera
        return guess if fitted is None else fitted.optimum.tool_from_camera.numpy()

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self._frames)

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
            row, sums = self._summed(row, images, "recorded" if plane_is_known else "estimated")
            if self._folder is not None:
                like = {"planes": self._like.planes, "amplitude": self._like.amplitude}
                values = {"like": like, **values_of_frame(row, sums)}
                save_values(self._file(number), FRAME_FORM, values, CalibrationDataError)
            self._take(number, row, sums)
            return self._taught(number)

    def _file(self, number: int) -> Path:
        """Return the file of a frame."""
        assert self._folder is not None
        return self._folder / f"frame-{number:06d}.pt"

    @property
    def _next(self) -> int:
        """Number of the next frame."""
        return next(reversed(self._frames), -1) + 1

    def remove(self, frame: int) -> Known | None:
        """Take a frame out again, and say what is known without it; None: it was the only one.

        Raises:
            CalibrationDataError: There is no such frame.
        """
        if frame not in self._frames:
            raise CalibrationDataError(f"There is no frame {frame} to remove.")
        if self._folder is not None:
            self._file(frame).unlink()
        del self._frames[frame]
        self._sums.pop(frame, None)
        self.known = self._learn(max(self._frames)) if self._frames else None
        return self.known

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
        if self.known is None or self.known.fit is None:
            return None
        found, random = self.known.fit, np.random.default_rng([seed, len(self)])
        dataset, frames, order = self._to_fit()
        lattice = joined([one.lattice for one in self._kept(order[k] for k in frames)])
        if not self.known.is_determined:
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
        return self._finished()[1]

    def _finished(self) -> tuple[Dataset, Fit]:
        """Return the frames, with their images if these were kept, and their calibration."""
        order = self._order()
        dataset, frames = self._dataset(order, found=False), np.arange(len(order))
        every = [one.thinned(most_pixels(len(order))) for one in self._kept(order)]
        if self._keeps_images:
            images = {k: np.concatenate([x.images[k] for x in every]) for k in every[0].images}
            data = Dataset((replace(dataset.first, **images),))
            data = data.without_stray_light(self.options.runtime.stray_light)
            data = usable_pixels(data, self.options, robust=False)
            all_of_them = {"split": SplitOptions(test_fraction=0.0)}
            options = self.options.model_copy(update=all_of_them)
            trained = calibration_of(data, options, Calibration)
            return trained.data, trained.fit
        lattice = joined([one.lattice for one in every])
        moments = _seen(every, dataset, frames)
        domain = covered_domain(dataset, frames, lattice)
        change = columns_on(self._terms, domain, self._domain)
        moments = replace(moments, gram=mapped(moments.gram, change))
        found = fit(dataset, frames, self.options, domain, moments=moments, lattice=lattice)
        return dataset, found

    def state(self) -> CalibrationState:
        """Return the calibration as the numbers that a corrector is built from.

        Without a network of what second bounces leave (`learned`): `save` trains it.
        """
        data, found = self._finished()
        return calibration_state(data, self.options, found, learned=False)

    def save(self, folder: Path | str) -> None:
        """Write `state.pt` and `corrector.ts` into a new folder, whole or not at all.

        Raises:
            CalibrationDataError: The frames do not determine the calibration, or the folder cannot
                be written.
        """
        state = with_remainder(self.options.runtime, self.state())
        with staged_folder(folder) as staged:
            save_calibration(staged / STATE_FILE, state)
            export_torchscript(DepthCorrector.from_state(state), staged / "corrector.ts", state)

    def _images(self, number: int, **given: Any) -> dict[str, np.ndarray | None]:  # noqa: ANN401
        """Return the images of one frame (1, H, W) as the recording format has them."""
        size = self.camera.height, self.camera.width
        for name in [name for name, image in given.items() if image is not None]:
            kind = IMAGE_ARRAYS[name]
            given[name] = np.array(given[name], dtype=kind.dtype)[None]
            if (got := given[name].shape[1:]) != size:
                raise CalibrationDataError(f"{name}: expected shape {size}, got {got}.")
            kind.check(given[name], [number], self._like.path)
        return given

    def _summed(
        self, row: FrameRow, images: dict[str, Any], planes: Literal["estimated", "recorded"]
    ) -> tuple[FrameRow, Sums]:
        """Return what is kept of a frame, its row with the plane where its wall starts."""
        before = self._like.planes, self._like.amplitude is None
        if self._frames and before != (planes, images["amplitude"] is None):
            said = "give amplitude and plane with every frame, or with none"
            raise CalibrationDataError(f"This frame differs from those before: {said}.")
        known: Any = None if images["amplitude"] is None else True  # The image itself is not kept.
        self._like = replace(self._like, planes=planes, amplitude=known)
        own = replace(self._like, frames=FrameTable.of([row]), **images)
        data = Dataset((own,)).without_stray_light(self.options.runtime.stray_light)
        data = usable_pixels(data, self.options, robust=False)
        # Radial distances were recorded in float32, which holds them without loss.
        exact = self._like.depth_kind == "radial" and data.exclude is None
        dtype = torch.float32 if exact else torch.float64
        batch = next(data.batches(image_dtype=dtype))
        lattice = lattice_in(batch, data.ray_directions())
        # What is known of the frames scales the condition terms, which the sums do not hold.
        domain = replace(covered_domain(data, [0], lattice), conditions={})
        self._widen(domain)
        moments = self._accumulator(batch)
        if planes == "estimated":
            row = self._on_its_wall(row, moments)
        if images["mask"] is None:
            images = images | {"mask": np.ones_like(images["depth"], np.uint8)}
        kept = {k: v for k, v in images.items() if v is not None and self._keeps_images}
        return row, Sums(self._domain, moments, lattice, kept)

    def _widen(self, domain: Domain) -> None:
        """Let the ranges of all frames hold others."""
        both = self._domain.joined(domain) if self._frames else domain
        if both != self._domain:
            self._domain = wider(both)
            model = ErrorModel(self._terms, self._domain)
            self._accumulator = self._accumulator.on(model, self._domain)
            self._sums = {k: one.on(self._domain, self._terms) for k, one in self._sums.items()}

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
        table = FrameTable.of([self._frames[k].row for k in numbers])
        for name, plane in self._planes.items() if found else ():
            at = table.target == name
            table.normal_world[at], table.offset[at] = plane
        like, size = self._like, (self.camera.height, self.camera.width)
        nothing = np.broadcast_to(np.float32(np.nan), (len(numbers), *size))
        amplitude = None if like.amplitude is None else nothing
        like = replace(like, frames=table, depth=nothing, amplitude=amplitude, mask=None)
        return Dataset((like,))

    def _kept(self, numbers: Iterable[int]) -> Iterator[Sums]:
        """Yield the sums of frames, on the ranges of all."""
        for k in numbers:
            kept = self._sums.get(k)
            yield kept or self._read(self._file(k))[2].on(self._domain, self._terms)

    def _order(self) -> list[int]:
        """Return the frames' numbers in the order of their time stamps."""
        return sorted(self._frames, key=lambda k: (self._frames[k].row.timestamp, k))

    def _to_fit(self) -> tuple[Dataset, np.ndarray, list[int]]:
        """Return all frames, which of them `add` fits, and their numbers."""
        order = self._order()
        return self._dataset(order), np.flatnonzero(self._is_fitted(np.array(order))), order

    def _is_fitted(self, numbers: np.ndarray) -> np.ndarray:
        """Return which frames `add` fits: a part of all, evenly spread over them."""
        parts = 1 << (-(-len(self) // _MOST_FITTED) - 1).bit_length()
        return scattered(numbers) * parts < 2**32

    def _take(self, number: int, row: FrameRow, sums: Sums) -> None:
        """Add a frame to those that are fitted, its sums on the ranges of all."""
        self._frames[number] = KeptFrame.of(row, sums.domain, sums.lattice)
        self._sums[number], count = sums, len(self)
        most, numbers = most_pixels(count), np.array([*self._sums])
        fewer = most < most_pixels(count - 1)
        for k in numbers if fewer else [number]:
            self._sums[k] = self._sums[k].thinned(most)
        if self._folder is not None:
            for k in numbers[~self._is_fitted(numbers)][: -_MOST_COMPARED - 1]:
                del self._sums[k]

    def _taught(self, number: int) -> Known:
        """Say what is odd about a new frame, and what is known with it."""
        odd, further = tuple(self._odd(number)), len(self._frames) - self._fitted
        if self.known is not None and further < _ONE_OF * len(self._frames):
            self.known = replace(self.known, frame=number, odd=odd, gained=0.0)
        else:
            self.known = replace(self._learn(number), odd=odd)
        return self.known

    def _learn(self, number: int) -> Known:
        """Fit the moments of all frames, and say how well the calibration is known."""
        before, (dataset, frames, order) = self.known, self._to_fit()
        here, poses = self._domain, dataset.pose_groups()
        if any(is_of_frames(term) for term in self.options.model.terms):
            here = replace(here, conditions=condition_ranges(dataset.conditions()))
        problem = Problem(dataset, frames, self.options, here, resumed=self._last_on(here))
        self._fitted, self._planes = len(order), {}
        self.known = Known(self.next_pose, number, int(poses.max()) + 1)
        try:
            with solvable(self._like.path, "fit"):
                sums = self._kept(order[k] for k in frames)
                found = fit_of_moments(problem, _seen(sums, dataset, frames))
        except CalibrationDataError:  # So few frames do not determine it.
            return self.known
        share = len(np.unique(poses[frames])) / self.known.poses
        self.known = self._judged(replace(self.known, fit=found), before, share)
        if found.walls is not None and self.known.is_determined:
            walls, names = found.walls.walls, [found.walls.names[k] for k in found.walls.numbers]
            planes = zip(walls.normal_world.numpy(), walls.offset.tolist(), strict=True)
            self._planes = dict(zip(names, planes, strict=True))
        return self.known

    def _last_on(self, domain: Domain) -> Parameters | None:
        """Return where the last fit stands, for some ranges; None: it was not determined.

        A fit that starts from anywhere may stay there, whatever further frames say.
        """
        last = None if self.known is None or not self.known.is_determined else self.known.fit
        if last is None or last.domain == domain:
            return last and last.optimum
        change = columns_on(last.options, last.domain, domain)
        return replace(last.optimum, coefficients=change.T @ last.optimum.coefficients)

    def _judged(self, now: Known, before: Known | None, share: float) -> Known:
        """Return the same with intervals, and what they gained on those before.

        Args:
            now: Its fit is of a share of the poses; the intervals are those that all will have.
            before: What was known before.
            share: Of the poses.
        """
        found = now.fit
        assert found is not None
        shift = turn = math.inf
        if found.optimum.hand_eye_is_free:
            # Few poses may scatter little by chance, but that is not what they determine.
            expected = posterior_covariance(found.observability.precision)[:6, :6]
            both = zip(worst_axes(found.hand_eye_covariance), worst_axes(expected), strict=True)
            quantile = student_quantile(39 / 40, found.covariance.degrees_of_freedom) * share**0.5
            shift, turn = (quantile * max(pair) for pair in both)
        free = {name for one in found.observability.undetermined for name in one.shares}
        # No less is known of a mount that nobody has measured.
        if free & {*HAND_EYE_SYMBOLS} or max(shift, turn) > PRIOR_SIGMA:
            shift = turn = math.inf
        shift, turn, gained = 1e3 * shift, math.degrees(turn), 0.0
        if before is not None and math.isfinite(shift):
            gained = 1 - max(shift / before.translation_mm, turn / before.rotation_deg)
        spread = (share * found.covariance.matrix.diagonal().clamp(min=0)).sqrt()
        spread = spread[found.optimum.twist_size :]
        return replace(
            now,
            translation_mm=shift,
            rotation_deg=turn,
            terms_mm=dict(zip(found.moments.symbols, (1e3 * spread).tolist(), strict=True)),
            weakest=next((one.in_words() for one in found.directions), ""),
            gained=gained,
            enough=shift <= self.wanted_mm and turn <= self.wanted_deg,
        )

    def _odd(self, number: int) -> list[str]:
        """Return what is odd about a frame, a sentence each."""
        newest = [*self._frames][-_MOST_COMPARED - 1 :]
        row, others = self._frames[number].row, [k for k in newest if k != number]
        said = self._apart([*others, number])
        earlier = [one for k in others if (one := self._frames[k].row).timestamp <= row.timestamp]
        last = max(earlier, key=lambda one: one.timestamp, default=row)
        moved = np.abs(row.world_from_tool - last.world_from_tool).max()
        if row.timestamp - last.timestamp <= _STREAM_S and moved > STANDSTILL:
            said.append("was taken while the robot moved: stand still for each frame.")
        return said

    def _apart(self, numbers: list[int]) -> list[str]:
        """Return what sets the last of some frames apart from the others, a sentence each."""
        # A wrong frame spoils the fit: it is judged by the one without it.
        last = None if self.known is None else self.known.fit
        if last is None or len(numbers) < _ENOUGH_TO_COMPARE:
            return []
        here = replace(self._domain, conditions=last.domain.conditions)
        best = self._last_on(here)
        if best is None:
            return []
        dataset, model = self._dataset(numbers), ErrorModel(last.options, here)
        every = np.arange(len(numbers))
        moments = _seen(self._kept(numbers), dataset, every)
        moments = with_condition_terms(model, moments, dataset.conditions())
        # Of each image's plane nothing is known, but for one ray, which shows no tilt.
        ridge = moments.count[:, None, None] * torch.eye(3).double() / 1e9
        within, whole = (
            (MomentObjective(own).image_losses(best).clamp(min=0) / own.count).sqrt().numpy()
            for own in (within_prior(moments, best, ridge), moments)
        )
        said = list[str]()

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


def _seen(sums: Iterable[Sums], dataset: Dataset, frames: np.ndarray) -> ImageMoments:
    """Return the moments of frames of a data set, which see its planes."""
    return lone_walls(dataset, frames).seen_by(concatenate([one.moments for one in sums]))


# Most frames that `add` fits. Chosen: the scatter between half as many is known to 12 %, and the
# intervals to 6 %; their fit takes as long as the sums of a VGA frame.
_MOST_FITTED = 256
# Frames from which on one is compared with the others, and the most of these, the newest. Chosen:
# the spread of fewer is chance (of eight, a clean one was called odd), and more tell no more.
_ENOUGH_TO_COMPARE, _MOST_COMPARED = 12, 99
# Share of the frames that are new before they are fitted once more. Chosen: an interval shrinks by
# a percent with them.
_ONE_OF = 1 / 50
# Time between frames of a stream, seconds: no robot moves and stands still again within it. Chosen.
_STREAM_S = 0.2
