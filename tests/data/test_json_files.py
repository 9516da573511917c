"""Lists of JSON read entry by entry are what reading them whole gives, faults included."""

import gzip
import json
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from extrap_train.data import json_files
from extrap_train.data.json_files import read_json, read_json_list
from extrap_train.errors import InputError

VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(), inner, max_size=4),
    max_leaves=12,
)


@settings(
    max_examples=25,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
@given(
    entries=st.lists(VALUES, min_size=1, max_size=8),
    piece=st.integers(1, 40),
    indent=st.sampled_from([None, 1]),
    escaped=st.booleans(),
)
def test_entries_are_those_of_the_whole_list(
    tmp_path: Path, entries: list, piece: int, indent: int | None, escaped: bool
) -> None:
    file = tmp_path / "list.jgz"
    text = json.dumps(entries, indent=indent, ensure_ascii=escaped)
    file.write_bytes(gzip.compress(text.encode(errors="surrogatepass"), 1))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(json_files, "_PIECE_BYTES", piece)
        try:
            expected = json.loads(text.encode())
        except UnicodeEncodeError:  # half of a surrogate pair, which no UTF-8 has
            with pytest.raises(InputError, match="is not valid JSON"):
                list(read_json_list(file, "things"))
        else:
            assert list(read_json_list(file, "things")) == expected == read_json(file)


@pytest.mark.parametrize("piece", range(1, 8))
def test_a_character_of_several_bytes_is_whole_wherever_a_piece_ends(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, piece: int
) -> None:
    monkeypatch.setattr(json_files, "_PIECE_BYTES", piece)
    file = tmp_path / "list.json"
    file.write_text('["é€𐀀", "𐀀é€"]', encoding="utf-8")
    assert list(read_json_list(file, "things")) == ["é€𐀀", "𐀀é€"]


@pytest.mark.parametrize("piece", range(1, 8))
@pytest.mark.parametrize("number", ["0.0", "-1.5", "1e-05", "2E+3", "-0", "17"])
def test_a_number_is_whole_wherever_a_piece_ends(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: str, piece: int
) -> None:
    monkeypatch.setattr(json_files, "_PIECE_BYTES", piece)
    file = tmp_path / "list.json"
    file.write_text(f"[{number},{number}]")
    assert list(read_json_list(file, "things")) == [float(number)] * 2


@pytest.mark.parametrize("piece", [1, 3, 1000])
@pytest.mark.parametrize(
    "text", ["[1, 2", "[1 2]", "[1,]", "[1, 2] 3", "[1, 2]]", '["a', "[1, nul]", "[{1: 2}]", ""]
)
def test_what_is_no_json_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str, piece: int
) -> None:
    monkeypatch.setattr(json_files, "_PIECE_BYTES", piece)
    file = tmp_path / "list.json"
    file.write_text(text)
    with pytest.raises(InputError, match=r"list\.json: is not valid JSON \(.*; download it again"):
        list(read_json_list(file, "things"))


@pytest.mark.parametrize(("text", "kind"), [("{}", "a dict"), ("3", "a int"), ("[]", "an empty")])
def test_what_is_no_list_is_refused(tmp_path: Path, text: str, kind: str) -> None:
    (tmp_path / "list.json").write_text(text)
    with pytest.raises(InputError, match=f"expected things in a list, found {kind}"):
        list(read_json_list(tmp_path / "list.json", "things"))
