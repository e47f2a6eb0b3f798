"""The recorded streams of lesson 08, all users scored anew from the networks that they stored."""

import numpy as np
import pytest
from records import stored

from dmsrd_lite.evaluation.comparison import score_method

pytestmark = pytest.mark.verify


@pytest.mark.parametrize("name", stored.STREAMS)
def test_scores_as_recorded(name):
    record, shown, learned = stored.stream(name)
    results, used = record["results"], record["parameters"]
    floor = np.array(shown.metadata["floor"])[results["arrival"]]
    assert floor == pytest.approx(results["floor"], abs=stored.FLOOR)
    test_set = stored.rewards_test_set(used["domain"])
    scores = score_method(learned, shown, None, test_set, [used["seed"], 99])
    stored.assert_equal(scores, results["table"], stored.DIVERGENCE_FAILING)
