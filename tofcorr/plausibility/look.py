"""Everything that the checks look at, computed once and when it is asked for."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np

from tofcorr.plausibility.alignment import Alignment, align
from tofcorr.plausibility.camera_parts import camera_parts
from tofcorr.plausibility.camera_step import CameraStep, camera_step
from tofcorr.plausibility.frame_offsets import FrameOffsets, frame_offsets
from tofcorr.plausibility.frame_planes import FramePlanes, frame_planes
from tofcorr.plausibility.free_walls import align_with_free_walls
from tofcorr.plausibility.image_shape import ImageShape, image_shape
from tofcorr.plausibility.length_scale import LengthScale, length_scale
from tofcorr.plausibility.linear_residuals import LinearResiduals, linear_residuals
from tofcorr.plausibility.own_errors import (
    by_amplitude,
    by_conditions,
    by_matt_wall,
    by_phase,
)
from tofcorr.plausibility.pose_drift import PoseDrift, pose_drift
from tofcorr.plausibility.sample import Sample
from tofcorr.plausibility.scene import Scene, moments_of

PlaneUse = Literal["known", "unknown", "ignored"]
"""`known`: the planes recorded are used; `unknown`: a start for the fit; `ignored`: not used."""


@dataclass(frozen=True, eq=False)
class Look:
    """A sample of a recording, with planes and alignments computed on demand.

    Attributes:
        sample: Some pixels of each frame.
        planes: What the command does with the recorded planes.
        fits: Whether the command fits a model; `check` does not.
    """

    sample: Sample
    planes: PlaneUse = "known"
    fits: bool = True

    @cached_property
    def rays(self) -> np.ndarray:
        """Unit rays of the sample's pixels, shape (F, P, 3)."""
        return self.sample.rays.reshape(-1, 3)[self.sample.pixel]

    @cached_property
    def distance(self) -> np.ndarray:
        """Distance along the rays, shape (F, P), metres; NaN: not usable."""
        return self.along_rays(self.sample.stored, self.rays)

    def along_rays(self, stored: np.ndarray, rays: np.ndarray) -> np.ndarray:
        """Return distances along rays from depth as stored."""
        return stored / rays[..., 2] if self.sample.recording.depth_kind == "z" else stored

    @cached_property
    def own(self) -> FramePlanes:
        """The plane of each frame by its own points."""
        return frame_planes(self.rays, self.distance)

    @cached_property
    def scene(self) -> Scene:
        """Poses and planes as recorded, points as measured; frames without a pixel left out."""
        whole = self.whole_scene(self.rays, self.distance, self.own)
        return whole.some(self.usable)

    @cached_property
    def usable(self) -> np.ndarray:
        """Which frames have a usable pixel, shape (F,), bool."""
        return np.asarray(self.own.on_plane.any(1) & np.isfinite(self.distance).any(1))

    @property
    def frames(self) -> np.ndarray:
        """Global numbers of the frames of `scene`."""
        return self.sample.frames[self.usable]

    def whole_scene(self, rays: np.ndarray, distance: np.ndarray, own: FramePlanes) -> Scene:
        """Return the scene of all frames, with these points."""
        sample = self.sample
        table = {
            name: sample.column(name) for name in ("world_from_tool", "normal_world", "offset")
        }
        used = own.on_plane & np.isfinite(distance)
        return Scene(
            poses=np.asarray(table["world_from_tool"]),
            normal=np.asarray(table["normal_world"]),
            offset=np.asarray(table["offset"]),
            moments=moments_of(rays, distance, used),
            own_normal=own.normal,
            known=own.known,
            moves=sample.data.moves,
            guess=np.asarray(sample.recording.tool_from_camera, dtype=np.float64),
        )

    @cached_property
    def as_given(self) -> Alignment | None:
        """The alignment as the command would see it; None where nothing can be aligned."""
        return None if self.planes == "ignored" else self.aligned(self.scene)

    def aligned(self, scene: Scene) -> Alignment | None:
        """Return the alignment of a scene, its walls free where the command takes them so."""
        if not len(scene.poses):
            return None
        if self.planes == "unknown":
            return align_with_free_walls(scene)
        return align(scene)

    @cached_property
    def flatness(self) -> float:
        """Median distance of a frame's points to their own plane, metres; 0 for single rays."""
        known = self.own.flatness[self.own.known]
        return float(np.median(known)) if len(known) else 0.0

    @cached_property
    def linear(self) -> tuple[Scene, LinearResiduals, np.ndarray] | None:
        """Frames with a plane of their own, their residuals near the alignment, and their rays.

        None where the recorded planes are not taken as right.
        """
        given = self.as_given
        known = self.scene.known
        if given is None or self.planes != "known" or not known.any():
            return None
        chosen = np.flatnonzero(self.usable)[known]
        seen = replace(given, rms=given.rms[known], angle=given.angle[known])
        scene, rays = self.scene.some(known), self.rays[chosen]
        used = (self.own.on_plane & np.isfinite(self.distance))[chosen]
        bright = by_amplitude(self.sample)[chosen]
        problem = linear_residuals(scene, seen, rays, self.distance[chosen], used, bright)
        if self.sample.amplitude is None:
            bright = by_matt_wall(problem.cosine, problem.distance, problem.used)
            problem = problem.with_columns(problem.cosine[..., None] * bright)
        return scene, problem, rays

    @cached_property
    def shape(self) -> ImageShape | None:
        """Errors of focal length and kind; None where they cannot be estimated."""
        if self.linear is None:
            return None
        scene, _, rays = self.linear
        return image_shape(scene, self._of_camera, rays, self.sample.recording.depth_kind)

    @cached_property
    def step(self) -> CameraStep | None:
        """A moment at which the camera surely moved on the tool; None: there is none to be told."""
        if self._offsets is None or (self.drift is not None and self.drift.counts):
            return None
        found = camera_step(self._offsets)
        return found if found is not None and found.counts else None

    @cached_property
    def parts(self) -> CameraStep | None:
        """Frames in any order whose camera sits elsewhere on the tool; None: none to be told."""
        if self._offsets is None or (self.drift is not None and self.drift.counts):
            return None
        return camera_parts(self._offsets)

    @cached_property
    def _offsets(self) -> FrameOffsets | None:
        """Offsets and tilts of the frames of distinct poses; None where there are too few."""
        return None if self.linear is None else frame_offsets(self.linear[0], self._of_camera)

    @cached_property
    def scale(self) -> LengthScale | None:
        """How much longer distances are than poses; None where that cannot be estimated."""
        if self.linear is None or self.as_given is None or not self.scene.moves:
            return None
        return length_scale(self.as_given, self.linear[1])

    @cached_property
    def _of_camera(self) -> LinearResiduals:
        """The residuals of `linear`, with errors that follow conditions and phase."""
        assert self.linear is not None
        problem = self.linear[1]
        conditions = by_conditions(self.sample)[self.usable][self.scene.known]
        frequency = self.sample.recording.modulation_frequency
        circular = by_phase(problem.distance, problem.used, frequency)
        return problem.with_errors_of_frames(conditions).with_columns(
            problem.cosine[..., None] * circular
        )

    @cached_property
    def drift(self) -> PoseDrift | None:
        """How far poses or walls drift; None where that cannot be estimated."""
        return None if self.linear is None else pose_drift(*self.linear[:2])

    @cached_property
    def rms(self) -> np.ndarray:
        """Distance of each frame's points to its plane, shape (F,), metres.

        Without what errors of a camera, of its header and a steady drift explain, where that can
        be told.
        """
        given = self.as_given
        assert given is not None
        left = given.rms.copy()
        if self._explained is not None:
            left[self.scene.known] = self._explained.rms
        return left

    @cached_property
    def planes_off(self) -> np.ndarray | None:
        """How far each frame's plane is from the recorded one, shape (F,), metres; NaN: unknown.

        Root mean square over its pixels, without what errors of a camera, of its header and a
        steady drift explain; None where that cannot be told.
        """
        if self._explained is None:
            return None
        off = np.full(len(self.scene.poses), np.nan)
        off[self.scene.known] = self._explained.planes_off
        return off

    @property
    def _explained(self) -> ImageShape | PoseDrift | None:
        """What explains most of the residuals, as far as that can be told."""
        return self.drift if self.drift is not None and self.drift.counts else self.shape

    def with_images(self, stored: np.ndarray, pixel: np.ndarray) -> Scene:
        """Return the scene if other depths had been measured, at other pixels."""
        rays = self.sample.rays.reshape(-1, 3)[pixel]
        distance = self.along_rays(stored, rays)
        scene = self.whole_scene(rays, distance, frame_planes(rays, distance))
        return replace(scene.some(self.usable), guess=self.scene.guess)
