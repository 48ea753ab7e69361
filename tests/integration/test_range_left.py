"""A film that leaves the range of a model's parameter: in which frames the run says so."""

from dataclasses import replace

import numpy as np

from morph_dslam.registration.registration import Registration
from morph_dslam.tracking.run_notices import RunWarning, notices_of
from morph_dslam.tracking.run_results import RunResults
from morph_dslam.tracking.state import State
from morph_dslam.tracking.tracker import Tracker
from tests.support.bent_sheet import bent_sheet_model
from tests.support.rendered_sequence import CAMERA, SheetFilm, sheet_state

UPPER = 0.010
#: Metres; the model of the tracker ends at `UPPER`.
ARCHES = np.concatenate([np.linspace(0.0, 0.055, 12), np.linspace(0.045, 0.0, 6)])


def test_a_range_that_is_left_is_named_in_every_frame_outside_however_far():
    model = bent_sheet_model(43, 31)
    arch, *others = model.parameters
    short = replace(model, parameters=(replace(arch, lower=0.0, upper=UPPER), *others))
    film, pose = SheetFilm(model), sheet_state(0.2).camera_from_object

    def state(height):
        return State(np.array([height, 0.0, 0.0]), pose)

    tracker = Tracker(short, CAMERA, Registration(short, state(0.0)), reference=film.frame(state(0.0)))
    run = RunResults(short, reference_frame=0)
    for number, height in enumerate(ARCHES):
        run.add(number, number / 30.0, tracker.track(film.frame(state(height))))
    first, *rest = notices_of(run)
    outside = int((ARCHES > UPPER).sum())
    assert (first.warning, first.data["parameter"], first.data["side"]) == (RunWarning.AT_BOUND, "arch", "upper")
    assert abs(first.data["count"] - outside) <= 1  # a frame may end at the bound just before
    widened = run.parameter_std()[:, 0] > 0.25 * UPPER
    assert widened.any()  # by themselves these deviations would leave the arch open
    for notice in rest:
        assert notice.warning is not RunWarning.UNOBSERVABLE or "arch" not in notice.data["parameters"]
        assert notice.warning is not RunWarning.AT_BOUND or notice.data["parameter"] != "arch"
