"""Depth images of a bag, with the amplitude images of the same times."""

import numpy as np

from tofcorr.errors import CalibrationDataError
from tofcorr.importing.given_intrinsics import GivenIntrinsics
from tofcorr.importing.images.coding import DepthCoding, amplitude_counts, depth_metres, turned
from tofcorr.importing.report import Refusal, RefusedViewError
from tofcorr.importing.rosbag.image_message import image_array
from tofcorr.importing.rosbag.messages import TopicMessages
from tofcorr.importing.source import DepthImage

_SAME_IMAGE = 0.01
"""Seconds between the stamps of depth and amplitude of one exposure: a third of a frame at 30 Hz;
most drivers give both one stamp."""


class BagSource:
    """Depth images of a bag; a `tofcorr.importing.source.DepthSource`.

    Args:
        depth: The depth images.
        amplitude: The amplitude images; None without.
        intrinsics: The camera's, of images as they are after `coding.rotate`.
        coding: How depth is to be read.

    Attributes:
        origin: The bag.
        names: The time stamp of each image, as text.
        times: Seconds, shape (N,), increasing.
        camera: The camera's intrinsics.
        refused: Depth images without an amplitude image of their time.
        warnings: Sentences for people.

    Raises:
        CalibrationDataError: No image can be read, or depth and amplitude share no time.
    """

    def __init__(
        self,
        depth: TopicMessages,
        amplitude: TopicMessages | None,
        intrinsics: GivenIntrinsics,
        coding: DepthCoding,
        origin: str,
    ) -> None:
        self.origin = origin
        self._depth, self._amplitude, self._coding = depth, amplitude, coding
        order = np.argsort(depth.stamps, kind="stable")
        names = [f"{stamp:.6f}" for stamp in depth.stamps]
        self.refused: list[Refusal] = []
        self._beside: np.ndarray | None = None
        if amplitude is not None:
            self._beside, gap = _nearest(amplitude.stamps, depth.stamps)
            alone = gap > _SAME_IMAGE
            if alone.all():
                raise CalibrationDataError(
                    f"{origin}: no image of {amplitude.topic} is stamped within "
                    f"{1e3 * _SAME_IMAGE:.0f} ms of one of {depth.topic}; the nearest is "
                    f"{gap.min():.3f} s away."
                )
            self.refused = [
                Refusal(view=names[k], reason=f"{amplitude.topic} has no image of its time")
                for k in order
                if alone[k]
            ]
            order = order[~alone[order]]
        self._order = order
        self.names = [names[k] for k in order]
        self.times = depth.stamps[order]
        self.camera = intrinsics.camera(self._first_size())
        self.warnings = []
        if not depth.stamped:
            self.warnings.append(
                f"The headers of {depth.topic} hold no time stamps; the times of receipt are used, "
                "which jitter by the delays of the network."
            )

    def close(self) -> None:
        """Close the bag."""
        self._depth.close()
        if self._amplitude is not None:
            self._amplitude.close()

    def read(self, number: int) -> DepthImage:
        """Read one image.

        Raises:
            RefusedViewError: It is damaged, has 8 bits a pixel, or is of another size.
        """
        place = int(self._order[number])
        topic = self._depth.topic
        depth = depth_metres(image_array(self._depth.read(place), topic), self._coding, topic)
        amplitude = None
        if self._amplitude is not None and self._beside is not None:
            counts = image_array(
                self._amplitude.read(int(self._beside[place])), self._amplitude.topic
            )
            amplitude = amplitude_counts(counts, self._coding, self._amplitude.topic)
        return DepthImage(depth, amplitude).of(self.camera)

    def _first_size(self) -> tuple[int, int]:
        """Return width and height of the first image that can be decoded."""
        reason = ""
        for place in self._order:
            try:
                image = image_array(self._depth.read(int(place)), self._depth.topic)
            except RefusedViewError as refusal:
                reason = reason or str(refusal)
                continue
            height, width = turned(image, self._coding.rotate).shape
            return width, height
        raise CalibrationDataError(
            f"{self.origin}: none of {len(self._order)} depth images can be used; the first: "
            f"{reason}."
        )


def _nearest(stamps: np.ndarray, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return which of `stamps` is nearest to each of `times`, and how far, seconds."""
    order = np.argsort(stamps, kind="stable")
    place = np.searchsorted(stamps[order], times)
    after = order[np.minimum(place, len(stamps) - 1)]
    before = order[np.maximum(place - 1, 0)]
    earlier = np.abs(times - stamps[before]) <= np.abs(times - stamps[after])
    nearest = np.where(earlier, before, after)
    return nearest, np.abs(times - stamps[nearest])
