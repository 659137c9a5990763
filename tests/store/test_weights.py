import numpy as np
import pytest

from pipeline.store.artifacts import read_weights, write_weights

ARRAYS = {
    "head.bias": np.arange(3, dtype=np.float32),
    "adam.count": np.array(7),
    "key": np.array([1, 2**32 - 1], np.uint32),
}


def test_arrays_come_back_bit_for_bit_with_what_was_said_of_them(tmp_path):
    write_weights(tmp_path / "a.safetensors", "classifier 1", ARRAYS, {"size": "small", "rates": "a=b"})
    arrays, about = read_weights(tmp_path / "a.safetensors", "classifier 1")
    assert about == {"size": "small", "rates": "a=b"}
    assert {name: (a.dtype, a.shape, a.tobytes()) for name, a in arrays.items()} == {
        name: (a.dtype, a.shape, a.tobytes()) for name, a in ARRAYS.items()
    }


def test_equal_arrays_give_equal_bytes_in_whatever_order_they_come(tmp_path):
    write_weights(tmp_path / "a.safetensors", "x", ARRAYS, {"p": "1", "q": "2"})
    write_weights(tmp_path / "b.safetensors", "x", dict(reversed(ARRAYS.items())), {"q": "2", "p": "1"})
    assert (tmp_path / "a.safetensors").read_bytes() == (tmp_path / "b.safetensors").read_bytes()


@pytest.mark.parametrize(
    "change, sentence",
    [
        (
            lambda path: path.unlink(),
            "weights.safetensors is missing; make it again with ./run dvc repro train_classifier",
        ),
        (
            lambda path: path.write_bytes(path.read_bytes()[:-5]),
            "holds no whole weights .*; make it again with ./run dvc repro train_classifier",
        ),
        (
            lambda path: write_weights(path, "classifier 1", ARRAYS, {}),
            "should hold weights of agent 1 but has schema classifier 1; ",
        ),
    ],
)
def test_what_is_not_whole_or_of_another_learner_is_one_sentence(tmp_path, monkeypatch, change, sentence):
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "datasets/train_classifier/weights.safetensors"
    write_weights(path, "agent 1", ARRAYS, {})
    change(path)
    with pytest.raises(ValueError, match=sentence):
        read_weights(path.relative_to(tmp_path), "agent 1")
