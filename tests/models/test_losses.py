import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

torch = pytest.importorskip("torch", reason="needs the train extra")

from models import losses  # noqa: E402 the extra is asked for first
from pipeline import labels  # noqa: E402
from pipeline.labels import group_table  # noqa: E402

CLASSES = len(labels.NAMES)


def by_hand(logits, target, groups, weights):
    """The definition, pixel by pixel in float64."""
    total = weight_sum = 0.0
    factor = target.shape[1] // logits.shape[2]
    for b, v, u in np.ndindex(target.shape):
        value = target[b, v, u]
        if value == labels.IGNORE:
            continue
        z = logits[b, :, v // factor, u // factor].astype(np.float64)
        p = np.exp(z - z.max()) / np.exp(z - z.max()).sum()
        total -= weights[value] * np.log(p[groups[b, value]].sum())
        weight_sum += weights[value]
    return total / max(weight_sum, 1.0)


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), factor=st.integers(1, 4), spread=st.sampled_from([0.1, 3.0, 8.0]))
def test_loss_is_the_definition(seed, factor, spread):
    rng = np.random.default_rng(seed)
    logits = (spread * rng.standard_normal((2, CLASSES, 3, 4))).astype(np.float32)
    target = rng.choice([*range(CLASSES), labels.IGNORE], (2, 3 * factor, 4 * factor)).astype(np.uint8)
    groups = np.stack([group_table({0: [0, 2, 3], 3: [3, 1]}), group_table()])
    weights = rng.uniform(0.5, 5.0, CLASSES).astype(np.float32)
    loss = losses.grouped_nll(
        torch.from_numpy(logits),
        torch.from_numpy(target),
        torch.from_numpy(groups),
        torch.from_numpy(weights),
    )
    assert float(loss) == pytest.approx(by_hand(logits, target, groups, weights), rel=1e-4, abs=1e-6)


def one(logits, value, folded=None):
    z = torch.tensor(logits, requires_grad=True)
    target = torch.full((1, 1, 1), value, dtype=torch.uint8)
    groups = torch.from_numpy(group_table(folded)[None])
    loss = losses.grouped_nll(z.view(1, CLASSES, 1, 1), target, groups, torch.ones(CLASSES))
    loss.backward()
    return float(loss.detach()), z.grad.numpy()


def test_single_classes_give_plain_cross_entropy():
    z = np.random.default_rng(0).standard_normal(CLASSES).astype(np.float32)
    loss, gradient = one(z, 2)
    p = np.exp(z) / np.exp(z).sum()
    assert loss == pytest.approx(-np.log(p[2]), rel=1e-5)
    assert np.allclose(gradient, p - np.eye(CLASSES)[2], atol=1e-6)


def test_inside_a_group_nothing_is_preferred():
    """The gradient of a group moves its classes by their own share: their ratio is not touched."""
    z = np.random.default_rng(1).standard_normal(CLASSES).astype(np.float32)
    _, gradient = one(z, 3, {3: [3, 1]})
    p = np.exp(z) / np.exp(z).sum()
    q = p[[1, 3]].sum()
    expected = p.copy()
    expected[[1, 3]] -= p[[1, 3]] / q
    assert np.allclose(gradient, expected, atol=1e-6)


def test_a_pixel_that_may_be_anything_teaches_nothing():
    loss, gradient = one(np.arange(CLASSES, dtype=np.float32), 0, {0: list(range(CLASSES))})
    assert loss == pytest.approx(0.0, abs=1e-6)
    assert np.allclose(gradient, 0.0, atol=1e-6)


def test_a_sure_and_wrong_answer_still_has_a_finite_gradient():
    z = np.zeros(CLASSES, np.float32)
    z[0] = 60.0
    loss, gradient = one(z, 5)
    assert loss == pytest.approx(60.0, rel=1e-4)
    assert np.allclose(gradient, np.eye(CLASSES)[0] - np.eye(CLASSES)[5], atol=1e-5)


def test_an_ignored_picture_gives_no_loss_and_no_gradient():
    loss, gradient = one(np.ones(CLASSES, np.float32), labels.IGNORE)
    assert loss == 0.0
    assert not gradient.any()


def test_a_target_that_does_not_fit_is_refused():
    with pytest.raises(ValueError, match="no whole multiple"):
        losses.grouped_nll(
            torch.zeros(1, CLASSES, 2, 2),
            torch.zeros(1, 4, 5, dtype=torch.uint8),
            torch.ones(1, CLASSES, CLASSES, dtype=torch.bool),
            torch.ones(CLASSES),
        )


def test_boosters_add_their_share_of_the_loss_at_their_cells():
    rng = np.random.default_rng(3)
    target = torch.from_numpy(rng.integers(0, CLASSES, (1, 8, 8)).astype(np.uint8))
    groups, weights = torch.from_numpy(group_table()[None]), torch.ones(CLASSES)
    head, coarse = torch.randn(1, CLASSES, 4, 4), torch.randn(1, CLASSES, 2, 2)
    got = losses.boosted_loss(head, [coarse], target, groups, weights, booster_share=0.5)
    at_cells = losses.grouped_nll(coarse, target[:, 2::4, 2::4], groups, weights)
    assert float(got) == pytest.approx(
        float(losses.grouped_nll(head, target, groups, weights) + 0.5 * at_cells)
    )
