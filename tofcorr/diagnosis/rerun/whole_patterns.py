"""The maps of a model in all pixels of a large image, of which the diagnosis chose some."""

from dataclasses import replace

import torch
from torch import Tensor

from tofcorr.diagnosis.findings.naming import NamedEffects
from tofcorr.diagnosis.rerun.fitted_simulator import simulator_of, solution_of, tables_of
from tofcorr.diagnosis.rerun.twin import simulated_frames
from tofcorr.diagnosis.sums.map_gain import map_spread, pixel_weight
from tofcorr.diagnosis.sums.study import Study
from tofcorr.geometry.rays import ray_directions
from tofcorr.simulation.effects import MapEffect
from tofcorr.simulation.options import SimulatorOptions
from tofcorr.simulation.twin import twin_frames

# A residual counts as so many standard deviations of noise and map at most. Chosen: flying pixels
# are farther off.
_FARTHEST = 3.0


def whole_patterns(
    study: Study, named: NamedEffects, given: SimulatorOptions | None
) -> dict[str, Tensor]:
    """Return the maps of the model, with values in all pixels, by name; metres.

    Of large images the diagnosis chooses some pixels, and knows a map in these alone. A simulator
    and a sensor need it everywhere. So the simulator without the map is run at the recording's
    poses, and a pixel's value is the weighted mean of what it measures too little, shrunk towards
    zero by the prior of all maps. Each frame's own offset and tilt is taken off before.

    Nothing is returned where all pixels were chosen, or where the built-in simulator cannot do all
    that the model does: other pixels have the value zero then.

    Args:
        study: The recording, before any effect was named.
        named: The effects named.
        given: The simulator under diagnosis; None: one made from the recording alone.
    """
    maps = [study.candidates.maps[name] for name in named.names if name in study.candidates.maps]
    rendered = given is None and study.fit.known is not None
    if (
        not maps
        or not study.observations.is_sample
        or rendered
        or tables_of(study, named, given).beyond
    ):
        return {}
    return {effect.name: _of_all_pixels(study, named, given, effect) for effect in maps}


def _of_all_pixels(
    study: Study, named: NamedEffects, given: SimulatorOptions | None, effect: MapEffect
) -> Tensor:
    """Return the value of each cell from all pixels, shape (cells,), metres."""
    observations = study.observations
    camera = observations.recording.camera
    others = replace(named, names=tuple(name for name in named.names if name != effect.name))
    spread = map_spread(study, effect, study.system.residual_of(named.columns))
    frames, usable = simulated_frames(observations.recording), observations.usable
    weights = torch.zeros(observations.num_frames, dtype=torch.float64)
    weights = weights.index_add(0, observations.frame, pixel_weight(study))
    weights = weights / torch.bincount(observations.frame, minlength=len(weights)).clamp(min=1)
    states = twin_frames(
        simulator_of(study, others, given),
        observations.recording,
        tool_from_camera=solution_of(study, others)[0],
        reflectivity="pattern" if observations.amplitude is None else "from_recording",
        indices=frames,
    )
    x, y, _ = ray_directions(camera).reshape(-1, 3).T
    surface = torch.stack([torch.ones_like(x), x, y], dim=1)
    cells = effect.cells_of_image(camera.height, camera.width)
    sums, total = torch.zeros(2, effect.num_cells(effect.shape), dtype=torch.float64)
    for frame, state in zip(frames, states, strict=True):
        measured = observations.distance_images[frame].double()
        left = (measured - state.measured_distance).flatten()
        used = usable[frame].flatten() & left.isfinite()
        if not bool(used.any()):
            continue
        own, left = surface[used], left[used]
        left = left - own @ torch.linalg.lstsq(own, left[:, None]).solution[:, 0]
        weight = weights[frame]
        farthest = _FARTHEST * float(1 / weight + spread**2) ** 0.5
        left = weight * left.clamp(-farthest, farthest)
        for cell in cells[used].unbind(1):
            sums.index_add_(0, cell, left)
            total.index_add_(0, cell, weight.expand_as(left))
    return sums / (total + spread**-2)
