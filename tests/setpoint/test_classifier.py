"""The classifier: the paper's sizes, layers against plain loops, augmentation that keeps the width, honest
splits, training that resumes to the same bytes."""

import functools
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pipeline.setpoint.vision import classifier
from pipeline.setpoint.vision.classifier import (
    Labelled,
    Rates,
    TrainingSettings,
    adr,
    along_bead,
    checked,
    cosine,
    cross_entropy,
    predict,
    split_by_segment,
    train,
    untrained,
)
from pipeline.setpoint.vision.vision_transformer import (
    PAPER,
    SMALL,
    Block,
    Classifier,
    Size,
    from_named_arrays,
    inverse_root,
    named_arrays,
    parameters,
    vision_transformer,
)

TINY = Size((16, 8), 8, 1, 2, 16, 8, 4)
KEY = jax.random.key(0)


def drawn(size: Size, seed: int = 0) -> Classifier:
    return vision_transformer(size, np.random.default_rng(seed))


def stripes(segments: int, frames: int, *, seed: int) -> Labelled:
    """Bright beads of 4, 7 or 10 rows on a dark plate, with noise and a shift: no class is hard."""
    rng = np.random.default_rng(seed)
    segment = np.repeat(np.arange(segments), frames)
    label = segment % 3
    across = np.abs(np.arange(16)[None, :] - 7.5 - rng.normal(0, 0.5, (len(label), 1)))
    bead = 60 + 120 * (across < (2 + 1.5 * label)[:, None])
    area = np.clip(bead[:, :, None] + rng.normal(0, 15, (len(label), 16, 48)), 0, 255).astype(np.uint8)
    flow = np.array([60.0, 100.0, 160.0])[label]
    return Labelled(area, rng.choice([190.0, 210.0, 230.0], len(label)), label, flow, segment)


SETTINGS = TrainingSettings(
    cycle_epochs=4,
    warmup_epochs=1,
    batch=16,
    learning_rate=3e-3,
    weight_decay=0.01,
    smoothing=0.0,
    averaging=0.9,
    patience=10,
)
DRAW = {"key": KEY, "augment": along_bead}


@functools.cache
def parts() -> tuple[Labelled, Labelled]:
    return stripes(24, 6, seed=1), stripes(9, 6, seed=2)._replace(segment=1000 + np.repeat(np.arange(9), 6))


@functools.cache
def trained():
    """Four epochs of the tiny network, and the states that it handed out."""
    states = []
    start = untrained(drawn(TINY), epochs=4)
    return train(start, *parts(), SETTINGS, on_step=states.append, **DRAW), states


def same(a, b) -> bool:
    a, b = named_arrays(a), named_arrays(b)
    return a.keys() == b.keys() and all(np.array_equal(a[name], b[name], equal_nan=True) for name in a)


# ---- sizes and layers


def test_the_papers_network_has_the_papers_parameters():
    network = drawn(PAPER)
    assert (parameters(network.body), parameters(network.head)) == (3_962_880, 33_363)
    assert parameters(network.flow_head) == 2 * (128 + 16) + 2  # ours, beside them


def test_the_small_transformer_has_some_76_thousand_parameters():
    assert parameters(drawn(SMALL)) == pytest.approx(75_800, rel=0.1)


def test_a_block_is_attention_then_feed_forward_as_loops_write_them():
    block = Block(Size((4, 4), 6, 1, 2, 10, 4, 4), np.random.default_rng(0))
    x = np.random.default_rng(0).normal(size=(5, 6))
    w = {name: np.asarray(a, float) for name, a in named_arrays(block).items()}

    def norm(row, name):
        return (row - row.mean()) / np.sqrt(row.var() + 1e-5) * w[f"{name}.scale"] + w[f"{name}.shift"]

    qkv = np.array(
        [norm(row, "norm_1") @ w["queries_keys_values.W"] + w["queries_keys_values.b"] for row in x]
    )
    seen = np.zeros((5, 6))
    for h in range(2):
        q, k, v = (qkv[:, 6 * i + 3 * h : 6 * i + 3 * h + 3] for i in range(3))
        for t in range(5):
            e = np.exp([q[t] @ k[s] / np.sqrt(3) for s in range(5)])
            seen[t, 3 * h : 3 * h + 3] = (e / e.sum()) @ v
    y = x + seen @ w["attended.W"] + w["attended.b"]
    wide = np.array([norm(row, "norm_2") @ w["expand.W"] + w["expand.b"] for row in y])
    gelu = wide / 2 * (1 + np.tanh(np.sqrt(2 / np.pi) * (wide + 0.044715 * wide**3)))
    for wanted in (5, 1):
        np.testing.assert_allclose(
            block(jnp.asarray(x[None], jnp.float32), wanted)[0],
            (y + gelu @ w["contract.W"] + w["contract.b"])[:wanted],
            atol=2e-5,
        )  # float32


def test_patches_are_read_where_their_positions_are():
    network = drawn(TINY).body
    x = np.random.default_rng(0).normal(size=(1, 16, 48)).astype(np.float32)
    order = np.array([3, 0, 5, 1, 4, 2])
    moved = x.reshape(16, 6, 8)[:, order].reshape(1, 16, 48)
    positions = jnp.concatenate([network.positions[:1], network.positions[1:][order]])
    turned = jax.tree_util.tree_map(lambda a: positions if a is network.positions else a, network)
    np.testing.assert_allclose(turned(moved), network(x), atol=1e-5)  # float32 sums in another order
    assert np.abs(network(moved) - network(x)).max() > 1e-4


def test_neither_lighting_nor_the_other_images_of_a_batch_change_the_logits():
    network = drawn(TINY)
    x = np.random.default_rng(0).integers(40, 200, (5, 16, 48))
    u = np.array([190.0, 200, 210, 220, 230])
    look = jax.jit(lambda x, u: network(x.astype(jnp.float32), u))
    logits = look(x, u)
    np.testing.assert_allclose(
        look(np.tile(x[2], (5, 1, 1)), np.full(5, 210.0))[0], logits[2], atol=1e-5
    )  # float32
    np.testing.assert_allclose(
        look(0.5 * x + 60, u), logits, atol=0.05
    )  # one gray level is added to the deviation of 46
    assert np.abs(look(x, u[::-1].copy()) - logits).max() > 1e-3


def test_predictions_are_the_mean_of_four_mirror_images_however_images_fall_into_batches():
    network, data = drawn(TINY), stripes(3, 7, seed=0)
    look = jax.jit(lambda x, u: network(x, u))
    whole = (
        sum(
            look(x, data.temperature_degC)
            for x in (data.key_area[:, ::a, ::b] for a in (1, -1) for b in (1, -1))
        )
        / 4
    )
    for batch in (4, 64):
        found = predict(network, data.key_area, data.temperature_degC, batch=batch)
        np.testing.assert_allclose(found.logits, whole, atol=1e-5)  # float32 products of other shapes
        assert found.features.shape == (21, TINY.image_features + TINY.temperature_features)
    assert predict(network, data.key_area[:0], data.temperature_degC[:0]).logits.shape == (0, 3)


# ---- weights


def test_weights_survive_as_named_arrays():
    network = drawn(TINY)
    arrays = named_arrays(network)
    assert arrays["body.blocks.0.expand.W"].shape == (8, 16)
    assert same(from_named_arrays(drawn(TINY, 1), arrays), network)


def test_weights_of_another_architecture_are_refused_by_the_first_array_that_differs():
    arrays = named_arrays(drawn(TINY))
    expected = (
        "weights of another architecture: body.blocks.0.attended.W is expected of shape (12, 12) but "
        "found of shape (8, 8); load them into"
    )
    with pytest.raises(ValueError, match=re.escape(expected)):
        from_named_arrays(drawn(TINY._replace(width=12)), arrays)
    with pytest.raises(
        ValueError, match=r"body.blocks.1.attended.W is expected of shape \(8, 8\) but found absent"
    ):
        from_named_arrays(drawn(TINY._replace(layers=2)), arrays)
    with pytest.raises(ValueError, match=r"body.more is expected absent but found of shape \(8,\)"):
        from_named_arrays(drawn(TINY), arrays | {"body.more": np.zeros(8)})


def test_patches_that_do_not_tile_are_refused():
    with pytest.raises(ValueError, match="a patch of 5 x 4 px does not tile the key area of 16 x 48"):
        vision_transformer(TINY._replace(patch=(5, 4)), KEY)


# ---- data and splits


@pytest.mark.parametrize("seed", range(20))
def test_no_segment_is_in_two_parts_and_every_class_near_its_share(seed):
    data = stripes(90, 4, seed=0)
    rows = split_by_segment(data, shares=(0.7, 0.1, 0.2), rng=np.random.default_rng(seed))
    np.testing.assert_array_equal(np.sort(np.concatenate(rows)), np.arange(360))
    assert sum(len(np.unique(data.segment[r])) for r in rows) == 90
    for r, share in zip(rows, (0.7, 0.1, 0.2), strict=True):
        for c in range(3):
            assert abs(np.sum(data.label[r] == c) - share * 120) <= 4 + 1e-9  # one segment of 4 images


def test_prints_that_hold_several_classes_are_split_too():
    rng = np.random.default_rng(0)
    segment, label = np.repeat(np.arange(12), 50), rng.choice(3, 600, p=[0.5, 0.2, 0.3])
    data = stripes(100, 6, seed=0)._replace(segment=segment, label=label)
    for r in split_by_segment(data, shares=(2.0, 1.0, 1.0), rng=rng):
        assert len(np.unique(data.segment[r])) in (3, 4, 5, 6)  # 3 or 6 of 12 by the shares
        assert len(np.unique(data.label[r])) == 3


def test_one_print_or_too_few_allow_no_split():
    data = stripes(6, 4, seed=0)
    with pytest.raises(
        ValueError,
        match=r"all 24 key areas come from one print, which allows no honest split; film at least 2 prints",
    ):
        split_by_segment(data._replace(segment=np.zeros(24)), shares=(0.5, 0.5), rng=np.random.default_rng(0))
    with pytest.raises(
        ValueError,
        match=(
            r"6 segments do not let each of 3 parts hold every class: part \d has none of class \d, .* "
            r"film more prints"
        ),
    ):
        split_by_segment(data, shares=(0.4, 0.3, 0.3), rng=np.random.default_rng(0))


def test_data_that_no_classifier_can_learn_from_is_refused_in_a_sentence():
    data = stripes(6, 4, seed=0)
    cases = {
        "class 2, over (flow > 110 %), has no key area among 16; add prints": data.take(
            np.flatnonzero(data.label < 2)
        ),
        "labels are expected to be 0, 1 or 2 but 1 of 24 are not, the first 7": data._replace(
            label=np.where(np.arange(24) == 5, 7, data.label)
        ),
        "key areas are expected as uint8 (24, 16, 48) but found uint8 (24, 48, 16)": data._replace(
            key_area=data.key_area.swapaxes(1, 2)
        ),
        "key areas are expected as uint8 (24, 16, 48) but found float64 (24, 16, 48)": data._replace(
            key_area=data.key_area / 255
        ),
        "flows are expected above 0 % but 1 of 24 are not, the first nan": data._replace(
            flow_percent=np.where(np.arange(24) == 5, np.nan, 100.0)
        ),
        "1 of 24 temperatures are no numbers": data._replace(
            temperature_degC=np.where(np.arange(24) == 5, np.nan, 210.0)
        ),
        "segment is expected once a key area, (24,), but found (3,)": data._replace(segment=np.arange(3)),
    }
    for sentence, bad in cases.items():
        with pytest.raises(ValueError, match=re.escape(sentence)):
            checked(bad)
    with pytest.raises(
        ValueError,
        match=r"6 segments are both learned and held out, the first 0; split with split_by_segment",
    ):
        train(untrained(drawn(TINY), epochs=1), data, data, SETTINGS, **DRAW)


# ---- augmentation


def test_cropping_along_the_bead_keeps_its_profile_and_the_published_crop_does_not():
    profile = np.random.default_rng(0).uniform(50, 200, 16)  # 20 % more brightness and contrast clip nothing
    x = jnp.asarray(np.tile(profile[:, None], (200, 1, 48)).reshape(200, 16, 48), jnp.float32)

    def likeness(augment):
        """Largest correlation of each image's profile with the profile or its
        mirror: 1 under any change of brightness and contrast."""
        seen = np.asarray(jax.jit(augment)(KEY, x), float).mean(axis=2)
        return np.array(
            [max(np.corrcoef(row, way)[0, 1] for way in (profile, profile[::-1])) for row in seen]
        )

    assert likeness(along_bead).min() > 1 - 1e-9  # float32
    assert np.mean(likeness(adr) < 0.95) > 0.3  # half are cropped across


def test_a_stretched_line_by_hand():
    x = jnp.arange(8.0).reshape(1, 1, 8)
    np.testing.assert_allclose(classifier._resample(x, jnp.zeros(1), jnp.ones(1)), x, atol=1e-6)
    half = classifier._resample(
        x, jnp.full(1, 2.0), jnp.full(1, 0.5)
    )  # pixels 2 .. 6 over eight places: 2 - 1/4, 2 + 1/4 ...
    np.testing.assert_allclose(half[0, 0], 1.75 + 0.5 * np.arange(8), atol=1e-6)


def test_every_operation_of_the_augmentation_comes_in_half_of_the_images():
    x = jnp.asarray(np.random.default_rng(0).uniform(50, 200, (4000, 16, 48)), jnp.float32)
    untouched = np.all(np.abs(np.asarray(jax.jit(adr)(KEY, x)) - np.asarray(x)) < 1e-3, axis=(1, 2)).mean()
    assert untouched == pytest.approx(
        0.5**5, abs=0.011
    )  # crop across, crop along, flip, brightness, contrast; four deviations of 4,000 draws


# ---- training


def test_the_learning_rate_falls_as_a_cosine_after_its_rise():
    rates = Rates(highest=1e-4, rise=4, cycle=100, weight_decay=0, smoothing=0, averaging=0)
    np.testing.assert_allclose(
        [cosine(t, rates) for t in (50, 100, 200)], [0.5e-4, 0.0, 1e-4], atol=1e-10
    )  # PyTorch's annealing rises again after its cycle
    assert cosine(0, rates) == pytest.approx(0.25e-4, rel=1e-6)


def test_the_loss_by_hand():
    logits = jnp.log(jnp.array([[0.7, 0.2, 0.1], [0.1, 0.3, 0.6]]))
    assert cross_entropy(logits, jnp.array([0, 1]), 0.0) == pytest.approx(
        -(np.log(0.7) + np.log(0.3)) / 2, rel=1e-6
    )
    smooth = [0.8 * np.log(0.7) + 0.1 * np.log(0.02), 0.1 * np.log(0.06) + 0.8 * np.log(0.3)]
    assert cross_entropy(logits, jnp.array([0, 1]), 0.3) == pytest.approx(-np.mean(smooth), rel=1e-6)


def test_the_loss_of_the_flow_by_hand_and_what_makes_it_least():
    flow = jnp.array([100.0, 200.0])
    found = classifier.flow_loss(jnp.zeros(2), jnp.log(jnp.array([1.0, 0.5])), flow)
    assert found == pytest.approx((0 + np.log(0.5) + 0.5 * (np.log(2) / 0.5) ** 2) / 2, rel=1e-6)
    # of flows with a deviation of 10 % it is least where the network says their mean, and 10 %
    many = 100 * jnp.exp(0.1 * jax.random.normal(KEY, (20_000,)))
    losses = [
        classifier.flow_loss(jnp.full(20_000, mean), jnp.full(20_000, np.log(s)), many)
        for mean, s in ((0.0, 0.1), (0.03, 0.1), (-0.03, 0.1), (0.0, 0.12), (0.0, 0.08))
    ]
    assert int(np.argmin(losses)) == 0


def test_a_tiny_network_learns_widths_that_anyone_can_see():
    settings = SETTINGS._replace(learning_rate=1e-2, cycle_epochs=30, patience=30)
    state = train(untrained(drawn(TINY), epochs=30), *parts(), settings, **DRAW)
    test = stripes(30, 10, seed=5)
    assert (
        np.mean(predict(state.best, test.key_area, test.temperature_degC).logits.argmax(axis=1) == test.label)
        > 0.95
    )  # chance is a third
    seen = predict(state.best, test.key_area, test.temperature_degC)
    error = np.log(test.flow_percent / 100) - seen.log_flow
    assert np.abs(error).mean() < 0.1  # the flows are 0.5 apart in their logarithm
    assert 0.5 < (error / seen.deviation).std() < 2
    history = np.asarray(state.history)
    assert history[int(state.best_epoch) - 1, 1] == np.nanmin(history[:, 1])


def test_the_same_seed_gives_the_same_bytes_and_another_does_not():
    again = train(untrained(drawn(TINY), epochs=4), *parts(), SETTINGS, **DRAW)
    assert same(again, trained()[0])
    other = train(untrained(drawn(TINY), epochs=4), *parts(), SETTINGS, **DRAW | {"key": jax.random.key(1)})
    assert not same(other.network, again.network)


def test_training_that_was_killed_resumes_to_the_very_same_weights():
    whole, states = trained()
    assert [int(s.epoch) for s in states] == [1, 2, 3, 4]
    checkpoint = named_arrays(states[1])
    start = from_named_arrays(untrained(drawn(TINY, 9), epochs=4), checkpoint)
    resumed = train(start, *parts(), SETTINGS, **DRAW)
    assert same(resumed, whole)


def test_an_epoch_as_one_program_is_an_epoch_step_by_step():
    network, data = drawn(TINY), parts()[0]
    start, rows, rates = (
        (network, network, classifier.ADAM.init(network)),
        [jnp.asarray(a) for a in data[:4]],
        Rates(1e-3, 1, 10, 0.01, 0.1, 0.9),
    )
    batches = jax.random.split(KEY, 5), jnp.arange(80).reshape(5, 16)
    whole, step_by_step = (
        form(along_bead, start, batches, rows, rates)
        for form in (classifier._steps, classifier._steps_on_cpu)
    )
    jax.tree.map(
        lambda p, q: np.testing.assert_allclose(p, q, atol=2e-5), whole, step_by_step
    )  # float32 through five steps of Adam


def test_training_ends_when_the_held_out_loss_has_not_improved_for_patience_epochs_and_keeps_the_best():
    learned, held_out = parts()
    order = np.random.default_rng(0).permutation(len(held_out.label))
    shuffled = held_out._replace(
        label=held_out.label[order], flow_percent=held_out.flow_percent[order]
    )  # whatever is learned makes these worse
    states = []
    state = train(
        untrained(drawn(TINY), epochs=40),
        learned,
        shuffled,
        SETTINGS._replace(patience=3, averaging=0.0, cycle_epochs=40),
        on_step=states.append,
        **DRAW,
    )
    assert int(state.epoch) == int(state.best_epoch) + 4 < 40
    assert same(state.best, states[int(state.best_epoch) - 1].average)
    assert np.isnan(np.asarray(state.history)[int(state.epoch) :]).all()


def test_training_that_diverges_says_so():
    with pytest.raises(
        ValueError,
        match=r"no epoch of 4 had a held-out loss that is a number; lower the learning rate of 1e\+30",
    ):
        train(untrained(drawn(TINY), epochs=4), *parts(), SETTINGS._replace(learning_rate=1e30), **DRAW)


def test_without_averaging_the_weights_themselves_are_judged():
    state = train(untrained(drawn(TINY), epochs=1), *parts(), SETTINGS._replace(averaging=0.0), **DRAW)
    assert same(state.average, state.network)
    assert not same(trained()[0].average, trained()[0].network)


def test_an_inverse_root_is_rounded_as_every_cpu_rounds_it():
    x = np.geomspace(1e-30, 1e30, 10_001).astype(np.float32)
    np.testing.assert_array_equal(jax.jit(inverse_root)(x), np.float32(1) / np.sqrt(x))
    np.testing.assert_allclose(jax.jit(jax.grad(inverse_root))(4.0), -0.0625, rtol=1e-7)


def test_no_program_of_a_classifier_asks_a_cpu_for_its_own_guess_of_a_root():
    """Intel's and AMD's instruction of that kind answer with other digits, and the weights with them."""
    network = drawn(SMALL)
    data = stripes(12, 4, seed=0)
    rows = [jnp.asarray(a) for a in data[:4]]
    state = untrained(network, epochs=1)
    carry, rates = (state.network, state.average, state.opt_state), Rates(1e-3, 1, 2, 0.1, 0.1, 0.9)
    chosen = KEY, jnp.arange(8)
    programs = [
        classifier._predict.lower(network, *rows[:2]),
        classifier._outputs.lower(network, *rows[:2]),
        classifier._step.lower(adr, carry, chosen, rows, rates),
    ]
    for program in programs:
        text = program.compile().as_text()
        assert "rsqrt" not in text and "rcp" not in text
