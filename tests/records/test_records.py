"""Every record: its form, and the settings that made it; what it stored scores again as it says."""

from itertools import islice

import numpy as np
import pytest
import torch
from records import stored

from dmsrd_lite.beyond.spanning_set import spanning_set
from dmsrd_lite.demonstrators import people
from dmsrd_lite.domains import DOMAINS
from dmsrd_lite.evaluation import comparison, searches
from dmsrd_lite.evaluation.metrics import demonstration_log_likelihood, reward_correlations, score_policies
from dmsrd_lite.evaluation.worth import able
from dmsrd_lite.learning.networks import under
from dmsrd_lite.learning.policy_optimization import train_policies
from dmsrd_lite.method.airl import clone_demonstrations
from dmsrd_lite.method.between_class_discrimination import recognized
from dmsrd_lite.method.divergence import policy_divergences
from dmsrd_lite.method.dmsrd import NEW_STRATEGY
from dmsrd_lite.method.policy_mixture import Mixtures
from dmsrd_lite.method.rewards import Rewards
from dmsrd_lite.workbook import benchmark, presets
from dmsrd_lite.workbook.lessons import lessons
from dmsrd_lite.workbook.records import RECORDS, same_settings


def holding(settings, key):
    """The settings, or those within them, that hold ``key``."""
    found = [holding(value, key) for value in settings.values() if isinstance(value, dict)]
    return settings if key in settings else next(filter(None, found), None)


@pytest.mark.parametrize("name", sorted(path.stem for path in RECORDS.glob("*.json")))
def test_a_record_is_small_and_says_what_made_it(name):
    record, _ = stored.record_of(name)
    assert record["name"] == name
    assert {"domain", "preset", "seed"} <= set(record["parameters"])
    assert {"torch", "mujoco", "python"} <= set(record["versions"])
    trains = holding(record["settings"], "discriminator_rate")
    assert name.startswith("04") or trains["ppo"]["learning_rate"] > 0
    assert (RECORDS / f"{name}.safetensors").stat().st_size < 1_000_000


def of(pattern):
    return sorted(path.stem for path in RECORDS.glob(f"{pattern}_*.json"))


FROM_NOTHING = of("0[23]")
FORMS = [name for name in of("06") if "_clone_" in name or "_nothing_" in name]


def restored(name, method):
    """A method's policies and rewards, as its record stored them."""
    record, tensors = stored.record_of(name)
    shown = stored.demonstrations(record["parameters"]["domain"])
    return comparison.restore(under(method, tensors), shown, record["results"].get("alpha", 0.0))


def prepared(name):
    """Of a record: itself, its networks, domain and seed."""
    record, tensors = stored.record_of(name)
    return record, tensors, DOMAINS[record["parameters"]["domain"]], record["parameters"]["seed"]


def assert_policies_score(actor, shown, seed, known, label, flown_again=False):
    """As the record says, but for what rounding does to rollouts (also of demonstrations flown again)."""
    scores = score_policies(actor, shown, [seed, 99])
    moved = np.abs(scores["log_likelihood_per_step"] - known["log_likelihood_per_step"])
    assert (moved < np.where(flown_again, stored.LIKELIHOOD_FLOWN, stored.LIKELIHOOD)).all(), (label, moved)
    spared = np.equal(known["failure_share"], 0) & (scores["failure_share"] == 0)
    close = np.abs(scores["divergence"] - known["divergence"]) < stored.DIVERGENCE
    assert close[spared].sum() >= 0.9 * spared.sum(), f"{label}: of those that never fail"
    n_able, n_known = (able(shown.domain, row).sum() for row in (scores, known))
    assert abs(n_able - n_known) <= 1, f"{label}: one may fall here and not there"


def test_lessons_07_and_08_draw_records_of_todays_settings():
    for name in (*of("07"), *of("08")):
        record, _ = stored.record_of(name)
        domain, lesson = record["parameters"]["domain"], "_".join(name.split("_")[:2])
        lesson = next(path.stem for path in lessons() if path.stem.startswith(lesson))
        settings = presets.choose(lesson, domain, "full")
        if isinstance(settings, presets.LifelongLesson):
            settings = settings.of(record["parameters"]["form"])
        assert same_settings(record["settings"], settings), name


@pytest.mark.verify
@pytest.mark.parametrize("name", FROM_NOTHING)
def test_recorded_policies_score_again_as_recorded(name):
    record, _, domain, seed = prepared(name)
    for method, known in record["results"]["table"].items():
        actor = restored(name, method).actor()
        assert_policies_score(actor, stored.demonstrations(domain.name), seed, known, method)


@pytest.mark.verify
@pytest.mark.parametrize("name", FROM_NOTHING)
def test_recorded_rewards_correlate_again_as_recorded(name):
    record, _ = stored.record_of(name)
    test, part = stored.rewards_test_set(record["parameters"]["domain"]), "task" if name[:2] == "03" else "g"
    for label, known in record["results"]["correlations"].items():
        if not label.startswith(("AIRL", "MSRD")):
            continue
        found = reward_correlations(
            test, restored(name, label).rewards.evaluate(test.observations, part)[0].mean(1)
        )
        assert vars(found) == pytest.approx(known, abs=stored.CORRELATION, nan_ok=True)


@pytest.mark.verify
@pytest.mark.parametrize("name", FROM_NOTHING + FORMS)
def test_fresh_policies_learn_again_as_recorded(name):
    """The whole training takes minutes; its first update, which depends on the reward, comes back."""
    record, _, domain, seed = prepared(name)
    lesson, part = "_".join(name.split("_")[:2]), "g" if name[:2] == "02" else "task"
    fresh = presets.choose(lesson, domain.name, "full").fresh
    assert same_settings(record["settings"]["fresh"], fresh)
    for label, known in record["results"]["worth"].items():
        assert np.shape(known["curves"]) == (fresh.n_iterations, fresh.n_strategies)
        if label in record["results"]["table"]:
            rewards = restored(name, label).rewards

            def paid(data, _seed, rewards=rewards):
                return rewards.evaluate(data.observations[:, :, 1:], part)[0]

            steps = islice(train_policies(domain, paid, fresh, seed + 100), 2)
            again = [r["environment_return"] / r["horizon"] for r in steps]
            moved = np.median(np.abs(np.array(again) - known["curves"][:2]), axis=1)
            assert (moved < stored.FIRST_UPDATE[domain.name]).all(), (label, moved)


@pytest.mark.parametrize("name", of("07"))
def test_recorded_estimates_of_the_task_correlate_as_recorded(name):
    """What the benchmark stored of 10,000 trajectories gives the correlations of its table."""
    record, tensors = stored.record_of(name)
    domain, scores = record["parameters"]["domain"], record["results"]["scores"]
    test, settings = stored.rewards_test_set(domain), presets.choose("07_benchmark", domain, "full")
    for label, estimated in tensors.items():
        method, start = label.split(", ")
        if method in benchmark.SHARED:
            row = scores[label][str(settings.main if start == "nothing" else settings.from_clone)]
            found = vars(reward_correlations(test, estimated.astype(float)))
            assert found == pytest.approx({k: row[k] for k in found}, abs=0.01, nan_ok=True), label


@pytest.mark.verify
@pytest.mark.parametrize("name", of("04"))
def test_weights_are_found_from_actions_as_recorded(name):
    record, _, domain, seed = prepared(name)
    settings, own_people = record["settings"], people.load_shipped_demonstrators(domain)
    shown = stored.demonstrations(domain.name)
    clones = clone_demonstrations(shown, [seed, 101], settings["cloning_steps"]).actor()
    m, n = min(settings["n_known"]), settings["n_newcomers"]
    some, nothing = np.random.default_rng([seed, 20, m]).permutation(10)[:m], {}
    own_seed = [seed, 20, m]
    again = [*searches.compare(nothing, own_people.select(some), clones.select(some), n, (), own_seed)]
    known = [r for r in record["results"]["rows"] if r["known"] == m and r["search"] == "likeliest actions"]
    for key in ("error", "deviation"):
        assert len(again) == len(known)
        moved = [abs(a[key] - r[key]) for a, r in zip(again, known, strict=True)]
        assert np.quantile(moved, 0.9) < stored.WEIGHT, (key, moved)


def fresh_takes(acting, domain, seed, n_fresh):
    """So many fresh takes of everybody, by their number."""
    return {k: people.fresh_takes(acting, domain, k, [seed, 60, k]) for k in n_fresh}


def assert_known(rewards, takes, pure, known, label):
    """As many strategy rewards know their person as ``known`` says, by the number of takes."""
    for k, some in takes.items():
        count = recognized(rewards.mean_rewards(some), pure).sum()
        assert count == pytest.approx(known[str(k)], abs=stored.RECOGNIZED), f"{label}, {k} takes"


@pytest.mark.verify
@pytest.mark.parametrize("name", of("05"))
def test_recorded_strategy_rewards_recognise_again_as_recorded(name):
    record, tensors, domain, seed = prepared(name)
    settings, weights = record["settings"], np.array(record["results"]["weights"])
    acting = Mixtures(people.load_shipped_demonstrators(domain).select(settings["users"]), weights)
    takes = fresh_takes(acting, domain, seed, settings["n_fresh"])
    test = stored.rewards_test_set(domain.name, "development_set")
    for label, known in islice(record["results"]["table"].items(), 4):  # ablations keep only numbers
        rewards = Rewards(domain, weights.shape[1], 0.99, 0, settings["msrd"]["alpha"])
        kept = {k: torch.tensor(v) for k, v in under(label, tensors).items()}
        rewards.load_state_dict(kept, strict=False)  # shaping is not kept
        counted = {str(k): known["recognized"][f"{k} fresh"] for k in takes}
        assert_known(rewards, takes, range(weights.shape[1]), counted, label)
        task = rewards.evaluate(test.observations, "task")[0].mean(1)
        assert reward_correlations(test, task).pearson == pytest.approx(known["task"], abs=stored.CORRELATION)


@pytest.mark.verify
@pytest.mark.parametrize("name", FORMS)
def test_recorded_runs_of_algorithm_1_score_again_as_recorded(name):
    record, tensors, domain, seed = prepared(name)
    settings, arrival = record["settings"], record["results"]["arrival"]
    weights = np.vstack([np.eye(len(settings["users"])), settings["mixtures"]])
    own_people = people.load_shipped_demonstrators(domain).select(settings["users"])
    mixed = people.fresh_takes(Mixtures(own_people, settings["mixtures"]), domain, 3, [seed, 50])
    shown = stored.demonstrations(domain.name).joined(mixed).select(arrival)
    acting, test = Mixtures(own_people, weights[arrival]), stored.rewards_test_set(domain.name)
    takes = fresh_takes(acting, domain, seed, settings["n_fresh"])
    for label, known in record["results"]["table"].items():
        n_strategies, alpha = len(known["pure"]), settings["loop"]["msrd"]["alpha"]
        learned = comparison.restore(under(label, tensors), shown, alpha, known["pure"])
        mixtures = np.array(arrival) >= len(settings["users"])
        assert_policies_score(learned.actor(), shown, seed, known, label, mixtures)
        task = learned.rewards.evaluate(test.observations, "task")[0].mean(1)
        assert reward_correlations(test, task).pearson == pytest.approx(
            known["pearson"], abs=stored.CORRELATION
        )
        assert_known(learned.rewards, takes, known["pure"], known["recognized_fresh"], label)
        assert n_strategies == learned.policies.n_strategies


TRIALS = [name for name in of("08") if "_seed" in name and ("_ours_" in name or "_as_printed_" in name)]


def lived(name):
    """A trial of lesson 08: its record's scores, what it ended with, its users."""
    record, tensors, domain, seed = prepared(name)
    found = record["results"]
    ((label, known),) = found["table"].items()
    users = stored.demonstrations(domain.name, "lifelong").select(found["arrival"])
    learned = comparison.restore(tensors, users, found["alpha"], known["pure"])
    return found, known, label, learned, users, domain, seed


@pytest.mark.parametrize("name", TRIALS)
def test_a_sample_of_the_hundred_scores_again_as_recorded(name):
    found, known, _, learned, users, *_ = lived(name)
    assert learned.weights == pytest.approx(np.array(found["weights"]))
    some = np.arange(0, users.n_demonstrations, 12)
    mixtures = Mixtures(learned.policies.actor(), learned.weights[some])
    found = demonstration_log_likelihood(mixtures, users.select(some)) / users.horizon
    expected = np.array(known["log_likelihood_per_step"])[some]
    assert found == pytest.approx(expected, abs=stored.LIKELIHOOD)


@pytest.mark.verify
@pytest.mark.parametrize("name", TRIALS)
def test_the_hundred_score_again_as_recorded(name):
    found, known, label, learned, users, domain, seed = lived(name)
    assert_policies_score(learned.actor(), users, seed, known, label)
    test = stored.rewards_test_set(domain.name)
    task = learned.rewards.evaluate(test.observations, "task")[0].mean(1)
    assert vars(reward_correlations(test, task)) == pytest.approx(
        {k: found["looks"][-1][k] for k in ("pearson", "spearman", "spearman_of_good")},
        abs=stored.CORRELATION,
    )
    everybody = people.stream_actor(stored.demonstrations(domain.name, "lifelong"))
    acting = Mixtures(everybody.actor, everybody.weights[found["arrival"]])
    takes = fresh_takes(acting, domain, seed, (3,))
    assert_known(learned.rewards, takes, known["pure"], known["recognized_fresh"], label)


@pytest.mark.verify
@pytest.mark.parametrize("name", [name for name in TRIALS if "pendulum_ours" in name])
def test_the_smaller_set_explains_whom_all_strategies_explained(name):
    found, _, _, learned, users, domain, seed = lived(name)
    eps, mixture = [r["threshold"] for r in found["records"]], presets.METHODS[domain.name].dmsrd.mixture
    actor = learned.policies.actor()
    least = spanning_set(actor, users, learned.weights, eps, mixture, seed)
    assert abs(len(least.kept) - len(found["spanning"]["kept"])) <= 1
    both = learned.actor(), Mixtures(actor.select([*least.kept]), least.weights)
    before, after = ((policy_divergences(some, users, [seed, 77]) > eps).sum() for some in both)
    assert after <= before + 5  # a KL scatters around eps


@pytest.mark.parametrize("name", [name for name in of("08") if "_orders_" in name])
def test_recorded_orders_are_orders_and_their_counts_agree(name):
    orders = stored.record_of(name)[0]["results"]["orders"]
    assert len({tuple(o["order"]) for o in orders}) == len(orders) == 20
    for o in orders:
        assert sorted(o["order"]) == list(range(25))
        assert o["pure"] == [i for i, b in enumerate(o["branches"]) if b == NEW_STRATEGY]
        assert o["looks"][-1]["strategies"] == len(o["pure"]) >= len(o["kept"])
        before, after = (np.greater(o[k], o["threshold"]).sum() for k in ("divergence", "kl_of_kept"))
        assert after <= before + 3  # a KL scatters around eps


@pytest.mark.parametrize("name", [name for name in of("08") if "_thousand_" in name])
def test_a_checkpoint_of_a_thousand_grows_by_its_weights_alone(name):
    found = stored.record_of(name)[0]["results"]
    assert [line[0] for line in found["lived"]] == list(range(1, 1001))
    assert np.diff(found["sizes"]) == pytest.approx(100 * 8 * len(found["pure"]), abs=16)
