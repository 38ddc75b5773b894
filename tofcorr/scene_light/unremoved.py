r"""How uncertain a distance is after second bounces were removed.

Standard deviations along the ray, independent of each other:

* the gain: :math:`\delta \, \sigma_s / s`, of what was removed, :math:`\delta`;
* the planes: what a further round would change, since the distances that were found give the next
  planes;
* the patches, 2 x 2 cells: how much :math:`\delta` varies within those that a cell is in;
* hidden surfaces: light by way of the backs of the patches, as bright as their fronts. All of it
  counts, for nobody knows what the backs are like;
* surfaces outside of the image, and what else bends planes, averaged over 5 x 5 cells.

Of surfaces outside nothing is known beforehand but this: with a probability of one half there is
none, else one at right angles to the largest plane, beyond any side of the image, at any place up
to where light ends, of any reflectivity :math:`\rho` up to that of white paper, all equally
probable. White, it would add :math:`x_h` to the distances. What that bends is seen far better than
what it adds: with y and :math:`z_h` what remains of the distances and of :math:`x_h` once place and
tilt of each large plane are left free,

.. math:: p(h, \rho) \propto \exp\Big(\rho \, z_h^T C^{-1} y
    - \frac{\rho^2}{2} z_h^T C^{-1} z_h\Big), \quad C = \sigma^2 + Q Q^T

Q are the gain, the planes, hidden surfaces and the calibration, each as one standard deviation of
it bends planes: they explain y as well. :math:`\sigma^2` is the variance of what nothing explains,
as if what is smooth were noise. The mean square of :math:`\rho \, x_h` counts. Nothing of it is
removed: that would do harm wherever something else bends planes.
"""

import math
from statistics import NormalDist

import torch
from torch import Tensor, nn

from tofcorr.scene_light.bounces import Planes, SecondBounces, SecondBouncesState, turned
from tofcorr.scene_light.gain import CONFIDENCE

_PLACES = 4
"""Places beyond a side of the image of which light is computed. Chosen: between them it is
interpolated; 8 change the shares of building seeds by half a percent."""


class UnremovedBounces(nn.Module):
    """Standard deviation of what second bounces still add to a distance, or lack.

    Args:
        bounces: What removes them.
        state: Of the same, with the interval of the gain.
        own: Its `spread` is the calibration's, as `RuntimeSigma` has it; None: that is exact.
    """

    toward: Tensor
    between: Tensor
    shares: Tensor
    rows: Tensor
    columns: Tensor

    def __init__(
        self, bounces: SecondBounces, state: SecondBouncesState, own: nn.Module | None = None
    ) -> None:
        super().__init__()
        self.bounces, self.own = bounces, own
        self.gain_error: float = 0.0
        if state.gain_interval is not None and state.gain > 0:
            low, high = state.gain_interval
            reach = NormalDist().inv_cdf((1 + CONFIDENCE) / 2)
            self.gain_error = (high - low) / (2 * reach * state.gain)
        inside, out = (rays[:2] / rays[2] for rays in (bounces.cell_rays, bounces.out_rays))
        # Left, above, right, below: rays beyond the border, and their direction in the image.
        outward = torch.cat([-torch.eye(3), torch.eye(3)])[[0, 1, 3, 4]].to(inside).T
        border = (outward[:2].T @ inside).amax(1)
        reach = torch.cat([border, out.square().sum(0).sqrt()]).amax()
        share = torch.arange(_PLACES).to(inside) / _PLACES
        rays = torch.lerp(border[:, None], reach, share) * outward[:, :, None]
        rays[2] = 1.0
        toward = torch.stack([rays, outward[:, :, None].expand_as(rays)])
        self.register_buffer("toward", toward.flatten(2))
        # As many places, and reflectivities, as there are rows of cells.
        shares = (torch.arange(bounces.rows).to(inside) + 0.5) / bounces.rows
        near = (1 - (_PLACES * shares[:, None] - torch.arange(_PLACES)).abs()).clamp(min=0)
        self.register_buffer("between", torch.block_diag(*4 * [near]))
        self.register_buffer("shares", shares)
        counts = bounces.rows, bounces.columns
        down, along = ((torch.arange(n) + 0.5) * bounces.cell - 0.5 for n in counts)
        self.register_buffer("rows", down[:, None])
        self.register_buffer("columns", along[None])

    def forward(self, radial: Tensor, amplitude: Tensor, valid: Tensor) -> Tensor:
        """Return standard deviations along the ray, metres.

        Args:
            radial: Without the camera's own error, second bounces left in, metres (H, W) or
                (B, H, W).
            amplitude: Measured, the camera's units.
            valid: Where the camera's own error is known: elsewhere it may bend what is flat.
        """
        if radial.dim() == 2:
            return self.of_frame(radial, amplitude, valid)
        found = torch.empty_like(radial)
        for i in range(radial.shape[0]):
            self.bounces.room.frame = i
            found[i] = self.of_frame(radial[i], amplitude[i], valid[i])
        self.bounces.room.frame = 0
        return found

    def of_frame(self, radial: Tensor, amplitude: Tensor, valid: Tensor) -> Tensor:
        """Return `forward` of one frame (H, W)."""
        bounces, waves = self.bounces, self.bounces.wave_numbers
        measured, strength = bounces.cells(radial, amplitude)
        shift, used, large = bounces.found(measured, strength)
        total = shift + bounces.learned(measured, strength, shift, used, large)
        known = bounces.planes(measured - shift)
        turn = bounces.direct_and(torch.zeros(2, len(waves), 1).to(shift))
        turn = turned(turn, [2 * k for k in waves], shift)
        ratio = bounces.indirect(known[0], known[1], known[2], strength, turn, 1)
        hidden = self.by_the_backs(known[0], known[1], strength)
        errors = torch.stack([bounces.shift(ratio) - shift, hidden, self.gain_error * shift])
        smooth = 1.0 / (known[0] * bounces.cell_rays.double()).sum(0)
        explained = errors.nan_to_num()
        if self.own is not None:
            # At the plane: functions of the measured distance would explain its noise.
            at = torch.stack([smooth + shift, strength]).nan_to_num(1.0).to(self.rows.dtype)
            at = at.unflatten(1, [bounces.rows, bounces.columns])
            own = self.own.spread(at[0], at[1], self.rows, self.columns)  # type: ignore[operator]
            explained = torch.cat([explained, own.flatten(1).to(explained.dtype)])
        judged, _ = bounces.cells(torch.where(valid, radial, math.nan), amplitude)
        light, left = self.outside(judged - total, smooth, known, strength, ratio, explained)
        variance = errors.square().sum(0) + self.within_patches(shift) + light
        variance = variance + self.means(left)[0].square()
        return bounces.in_pixels(variance.sqrt(), radial, total, used)

    def outside(
        self,
        here: Tensor,
        smooth: Tensor,
        known: Planes,
        strength: Tensor,
        ratio: Tensor,
        explained: Tensor,
    ) -> tuple[Tensor, Tensor]:
        """Return the mean square of light from outside of the image, and what bends planes still.

        Args:
            here: Distances after the removal (N,), metres; NaN where they tell nothing.
            smooth: Those of the planes (N,).
            known: As `SecondBounces.planes` returns them.
            strength: Amplitudes of the cells (N,).
            ratio: From `SecondBounces.indirect` (2, F, N).
            explained: Other errors, one standard deviation each (K, N), metres.

        Returns:
            Square metres (N,), and metres (N,).
        """
        left, moves = here - smooth, smooth.square() * self.bounces.cell_rays.double()
        planes, used = known[0], known[2] & left.isfinite() & strength.isfinite()
        if not bool(used.any()):
            return torch.zeros_like(left), left
        light = self.columns_beyond(known, strength, ratio, planes[:, used].mode(1)[0])
        shown, free = torch.cat([left[None], light, explained]), used
        while bool(free.any()):
            face = free & (planes == planes[:, free][:, :1]).all(0)
            free = free & ~face
            base = torch.linalg.qr(moves[:, face].T)[0]
            shown[:, face] = shown[:, face] - (shown[:, face] @ base) @ base.T
        values, others = shown[0, used], shown[1 + len(light) :, used]
        every, lines = shown[1:, used], self.between.to(light) @ shown[1 : 1 + len(light), used]
        least = torch.linalg.pinv(every @ every.T, hermitian=True) @ (every @ values)
        left[used] = values - least @ every
        mean, count = self.means(left)
        noise = torch.maximum((mean.square() * count)[used].mean(), left[used].square().mean())
        noise = torch.where(noise > 0, noise, 1.0)
        by_others, shares = lines @ others.T, self.shares.to(light)
        other = others @ others.T + noise * torch.eye(len(others)).to(noise)
        weight = by_others @ torch.linalg.inv(other)
        along = lines @ values - weight @ (others @ values)
        square = lines.square().sum(1) - (weight * by_others).sum(1)
        odds = shares * (along[:, None] - 0.5 * shares * square[:, None]) / noise
        odds = torch.cat([odds.flatten(), torch.full_like(along[:1], math.log(odds.numel()))])
        chance = torch.softmax(odds, 0)[:-1].reshape(len(along), -1)
        left[used] = values - (chance * shares).sum(1) @ lines
        return (chance * shares.square()).sum(1) @ (self.between.to(light) @ light).square(), left

    def means(self, values: Tensor) -> tuple[Tensor, Tensor]:
        """Return means of known values (N,) in windows around each cell, and how many these are."""
        image = torch.stack([values.nan_to_num(), values.isfinite().to(values.dtype)])
        image = image.reshape(2, self.bounces.rows, self.bounces.columns)
        side = self.bounces.cell_planes.side
        sums = nn.functional.avg_pool2d(image, side, 1, side // 2, divisor_override=1).flatten(1)
        return sums[0] / sums[1].clamp(min=1.0), sums[1]

    def within_patches(self, shift: Tensor) -> Tensor:
        """Return the variance of values (N,) in 2 x 2 cells, the mean of the four with a cell."""
        image = torch.stack([shift, shift.square()])
        image = image.reshape(1, 2, self.bounces.rows, self.bounces.columns)
        means = nn.functional.avg_pool2d(image, 2, 1, 1, count_include_pad=False)[0]
        inside = (means[1:] - means[:1].square()).clamp(min=0)
        return nn.functional.avg_pool2d(inside, 2, 1).reshape(-1)

    def columns_beyond(
        self, known: Planes, strength: Tensor, ratio: Tensor, plane: Tensor
    ) -> Tensor:
        """Return what white surfaces at right angles to a plane add to distances (S, N), metres.

        They begin where the rays `toward` meet the plane, and hide what stands behind them.

        Args:
            known: As in `outside`.
            strength: As in `outside`.
            ratio: As in `outside`.
            plane: Its g (3,).
        """
        bounces, waves, planes = self.bounces, self.bounces.wave_numbers, known[0]
        place, normal, away, cosine, area = bounces.surfaces(
            planes, bounces.cell_rays.double(), bounces.solid.double()
        )
        seen = planes.isfinite().all(0) & strength.isfinite() & (cosine > bounces.steepest)
        turn = bounces.direct_and(ratio)
        turn = (turn / turn.square().sum(0).sqrt()).nan_to_num()
        light = torch.where(seen, strength * area, 0.0)
        light = turned(turn * light, waves, away.nan_to_num())
        middle, facing, whole, fronts = bounces.patches(place, normal, area, light, seen & known[1])
        shown = torch.cat([middle, facing, whole[None]])
        bright = strength * away.square() / cosine
        far, there = bounces.around(planes, place, bright, seen & known[1], known[2])
        edge = turn[:, :, bounces.out_from]
        here = torch.cat([place, normal]).nan_to_num()
        white = math.pi * bounces.gain  # The reflectivity of what sends an amplitude of one.
        out, found = bounces.out_rays.double(), torch.jit.annotate(list[Tensor], [])
        for i in range(self.toward.shape[2]):
            ray, outward = self.toward[0, :, i].to(out), self.toward[1, :, i].to(out)
            # Along the plane, away from the image. The surface faces the other way.
            along = outward * (plane @ ray) - ray * (plane @ outward)
            new = (along * ((plane @ ray) / (along @ ray)))[:, None].expand(3, out.shape[1])
            met = (new * out).sum(0)
            first = (met > 0) & (plane @ ray > 0) & (along @ ray > 0)
            first = first & ((met > (far * out).sum(0)) | (there == 0))
            lit, sent = bounces.beyond(new, first.to(there.dtype))
            dark, lost = bounces.beyond(far, torch.where(first, -white * there, 0.0))
            lit, sent = lit[:, sent > 0], sent[sent > 0]
            # What the rest sends falls on it too: this adds all orders of bounces between them.
            kept, still = bounces.beyond(far, torch.where(first, 0.0, there))
            rest = torch.cat([fronts, turned(edge * still, waves, kept[7])], dim=2)
            q = self.received(lit[:6], torch.cat([shown, kept[:7]], dim=1), rest)
            q = turned(q * (bounces.gain * lit[6] / sent), [-k for k in waves], lit[7])
            sends = turned(bounces.direct_and(q) * sent, waves, lit[7])
            gone = turned(edge * lost, waves, dark[7])
            put = torch.cat([lit, dark], dim=1)
            more = self.received(here, put[:7], torch.cat([sends, gone], dim=2))
            more = turned(more, [-k for k in waves], away) * (away.square() / cosine / math.pi)
            found.append(bounces.shift(ratio + more) - bounces.shift(ratio))
        return torch.where(seen, torch.stack(found).nan_to_num(), 0.0)

    def received(self, here: Tensor, patches: Tensor, light: Tensor) -> Tensor:
        """Return `SecondBounces.gathered` (2, F, N) with nothing hidden.

        Args:
            here: Place and normal of what gets the light (6, N).
            patches: Place, normal and area of what sends it (7, P).
            light: That they send, times their area, (2, F, P).
        """
        dtype, light = self.rows.dtype, light.to(self.rows.dtype)
        here, patches, free = here.to(dtype), patches.to(dtype), torch.zeros(0, 0).to(light)
        place, normal, area = patches[:3], patches[3:6], patches[6]
        return self.bounces.gathered(here, place, normal, area, light, free).double()

    def by_the_backs(self, planes: Tensor, fits: Tensor, amplitude: Tensor) -> Tensor:
        """Return what light adds that goes from patches to backs of patches to the cells (N,).

        Args:
            planes: g of the cells (3, N).
            fits: Which of them are on a plane (N,).
            amplitude: Of the cells (N,).
        """
        bounces, waves = self.bounces, self.bounces.wave_numbers
        place, normal, away, cosine, area = bounces.surfaces(
            planes, bounces.cell_rays.double(), bounces.solid.double()
        )
        seen = planes.isfinite().all(0) & amplitude.isfinite() & (cosine > bounces.steepest)
        grey = torch.where(seen, bounces.gain * amplitude * away.square() / cosine, 0.0)
        light = bounces.direct_and(torch.zeros(2, len(waves), 1).to(place))
        light = turned(light * torch.where(seen, amplitude * area, 0.0), waves, away.nan_to_num())
        sends = seen & fits
        middle, facing, whole, light = bounces.patches(place, normal, area, light, sends)
        fronts = torch.cat([middle, facing, whole[None]])
        place, normal = place.nan_to_num(), normal.nan_to_num()
        back = self.received(torch.cat([place, -normal]), fronts, light) * grey
        back = back * torch.where(sends, area, 0.0)
        _, _, _, light = bounces.patches(place, normal, area, back, sends)
        backs = torch.cat([middle, -facing, whole[None]])
        ratio = self.received(torch.cat([place, normal]), backs, light)
        ratio = turned(ratio, [-k for k in waves], away.nan_to_num())
        scaled = ratio * (bounces.gain * away.square() / cosine)
        return bounces.shift(torch.where(seen, scaled, 0.0))
