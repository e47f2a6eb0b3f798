"""What records stored, restored; and how nearly it must score again.

Another CPU rounds differently. What stored networks say about stored states hardly notices. A rollout does:
rounding grows from step to step, and now and then a policy falls on one machine and not on the other.
"""

from functools import cache

from dmsrd_lite.demonstrations import load_shipped, load_shipped_test_set
from dmsrd_lite.domains import DOMAINS
from dmsrd_lite.workbook.records import load_record

LIKELIHOOD = 1e-3  # nats per step: stored networks on stored actions
LIKELIHOOD_FLOWN = 0.03  # nats per step: stored networks on actions of flights flown again
CORRELATION = 1e-3  # stored networks on 10,000 stored trajectories
DIVERGENCE = 0.3  # nats: new rollouts of policies that seldom fail
WEIGHT = 0.02  # of nine mixtures in ten, from the actions: the clones are trained again. Another CPU: one in
# twenty stood in another hollow, .05 away
FIRST_UPDATE = {  # true reward per step after one update, the median policy. Another CPU: 0.000 and 0.015,
    "inverted_pendulum": 0.002,  # a negated reward: 0.003 and more
    "lunar_lander": 0.03,  # a negated reward: 0.05 and more
}
RECOGNIZED = 1  # strategies: fresh takes fly another way on another CPU, and one may stand on the edge

record_of = cache(load_record)


@cache
def demonstrations(domain, kind="demonstrations"):
    return load_shipped(DOMAINS[domain], kind)


@cache
def rewards_test_set(domain, kind="test_set"):
    return load_shipped_test_set(DOMAINS[domain], kind)
