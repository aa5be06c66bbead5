# SPDX-License-Identifier: Apache-2.0
"""Scenes survive encoding and decoding within the errors that the file declares, or they are refused.

Also: csplat.encoder.coding_parameters, csplat.encoder.encode_options, csplat.encoder.pipeline,
csplat.encoder.sh_codebook.
"""

import itertools
import math
import sys
from contextlib import suppress
from dataclasses import replace

import numpy as np
import pytest
from checked import measure_errors
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from tables import failures

import csplat
from csplat import SplatModel, _spec
from csplat.context import Context
from csplat.decoder import read_options
from csplat.encode_api import encode, encode_planned, encode_with_report
from csplat.encoder import PRESETS, EncodeOptions, EncodePlan
from csplat.errors import InputError
from csplat.scene_metadata import SceneMetadata

PRESET_NAMES = tuple(PRESETS)


def round_trip(model: SplatModel, importance: np.ndarray | None = None, **options: object):
    """Encode and decode; assert that the declared errors bound the measured ones."""
    result = encode_with_report(model, EncodeOptions(**options), importance=importance)
    decoded = csplat.decode(result.data)
    assert list(range(len(model))) == sorted(result.source_index.tolist())
    assert len(model) == len(decoded)
    for name, (largest, rms) in measure_errors(model, decoded, result.source_index).items():
        assert largest <= result.report.errors[name][0], name
        assert rms <= result.report.errors[name][1], name
    return decoded, result


@pytest.mark.slow
def test_scenes_of_any_size_and_coding_decode_within_declared_errors(make_model):
    # CNF-5, SRC-4
    plain, few = make_model(200, 0), make_model(200, 2)
    corners = np.sign(make_model(60, 0).means)
    book = {"sh_coding": "codebook", "codebook_size": 16}
    cases = {f"{count} splats": (make_model(count, 1), {"tile_splats": 100}) for count in (0, 1, 2, 99, 100, 101)}
    cases |= {f"degree {n}": (make_model(200, n), {"preset": PRESET_NAMES[n % 3]}) for n in range(5)}
    cases |= {f"preset {name}": (make_model(200, 3), {"preset": name}) for name in PRESET_NAMES}
    cases |= {f"{share} escapes": (few, {**book, "escape_fraction": share}) for share in (0.0, 0.1, 1.0)}
    for size, preset in zip((1e-30, 1e-10, 1.0, 1e7, 1e30), itertools.cycle(PRESET_NAMES)):
        cases[f"means of {size}"] = replace(plain, means=plain.means * np.float32(size)), {"preset": preset}
    for step, size in itertools.product((1e-250, 1e250), (1e-38, 1.0, 3e38)):
        model = make_model(60, 0, means=corners * np.float32(size))
        cases[f"means of {size} by {step}"] = model, {"position_step": step}
    extreme = make_model(64, 3)
    extreme.scales[:8], extreme.scales[8:16], extreme.scales[16] = 60, -60, 3e38
    extreme.means[0], extreme.means[1], extreme.shN[3], extreme.sh0[5] = 3e38, -3e38, -1e6, [1e6, -1e6, 3e38]
    cases |= {f"extremes, {name}": (extreme, {"preset": name}) for name in PRESET_NAMES}
    for means_coding, deflate in itertools.product(("morton", "axis"), ("libdeflate", "zlib")):
        cases[f"{means_coding}, {deflate}"] = plain, {"means_coding": means_coding, "deflate": deflate}
    for coding, degree in itertools.product(("codebook", "scalar", "none"), (1, 2, 3, 4)):
        cases[f"degree {degree}, {coding}"] = make_model(200, degree), {"sh_coding": coding, "tile_splats": 90}

    def check(case):
        model, options = case
        decoded, result = round_trip(model, **options)
        assert (0 if options.get("sh_coding") == "none" else model.sh_degree) == decoded.sh_degree
        assert options.get("sh_coding", result.report.options["sh_coding"]) == result.report.options["sh_coding"]

    assert [] == failures(cases, check)


def test_errors_of_means_in_doubles_are_declared_against_the_doubles(make_model):
    # 5.5: the distance of origin + mean from the source's mean. Rounding to float32 changes its sixth digit.
    origin = (481_250.0, 5_467_100.0, 310.0)
    doubles = np.random.default_rng(1).normal(0, 40, (400, 3)) + np.array(origin)
    means = (doubles - np.array(origin)).astype(np.float32)
    result = encode_with_report(make_model(400, 0, means=means, origin=origin, means_double=doubles))
    decoded = csplat.decode(result.data)
    away = np.linalg.norm(decoded.means + np.array(decoded.origin) - doubles[result.source_index], axis=1)
    rounded = np.linalg.norm(decoded.means.astype(np.float64) - means[result.source_index], axis=1)
    assert (away.max(), np.sqrt(np.square(away).mean())) == pytest.approx(result.report.errors["means"], rel=1e-6)
    assert away.max() != pytest.approx(rounded.max(), rel=1e-5)


def test_all_metadata_decode(make_model):
    given = {
        "coordinate_system": "RDF", "unit_metres": 0.5, "antialiased": True,
        "flat": True, "entries": {"title": "Übung", "comments": ["one"]}, "colour_space": "lin_rec709_display",
        "cameras": [{"K": [[1, 0, 2], [0, 1, 2], [0, 0, 1]], "viewmat": np.eye(4).tolist(), "W": 4, "H": 4}],
    }  # fmt: skip
    decoded, _ = round_trip(make_model(20, 1, **given, origin=(4.5e6, -1e7, 12.25)))
    assert (SceneMetadata(**given), (4.5e6, -1e7, 12.25)) == (decoded.metadata, decoded.origin)


def test_up_to_64_extra_columns_keep_their_bits_in_any_byte_order(make_model):
    columns = {
        dtype: np.frombuffer(np.random.default_rng(0).bytes(20 * np.dtype(dtype).itemsize), dtype)
        for dtype in ("<i4", ">i4", "<f8", ">f8", ">u2", "i1")
    }
    columns |= {f"c{i}": np.arange(20, dtype=np.uint8) for i in range(58)}
    model = make_model(20, 0, extra=columns)
    decoded, result = round_trip(model, keep_extra=True)
    assert list(columns) == list(decoded.extra)
    for name, column in columns.items():
        kept = decoded.extra[name]
        assert column.dtype.newbyteorder("<") == kept.dtype
        assert column[result.source_index].tobytes() == kept.astype(column.dtype).tobytes()
    with pytest.raises(InputError, match="65 extra columns, expected at most 64"):
        round_trip(replace(model, extra=columns | {"last": columns["c0"]}), keep_extra=True)


def test_extra_columns_are_kept_or_their_loss_is_told(make_model, tmp_path):
    csplat.write_ply(tmp_path / "a.ply", make_model(200, 0, extra={"object_id": np.arange(200, dtype=np.int32)}))
    model = csplat.read(tmp_path / "a.ply")
    text = "extra columns object_id are dropped: .* keep_extra=True keeps them"
    with pytest.warns(UserWarning, match=text) as caught:
        data = encode(model)
    with pytest.warns(UserWarning, match=text), csplat.open(tmp_path / "a.ply") as scene:
        encode(scene, EncodeOptions(bucket_splats=100), out=tmp_path / "a.csplat", context=Context(workers=1))
    assert [__file__] == [warning.filename for warning in caught]
    (note,) = encode_with_report(model).report.notes
    assert note == str(caught[0].message)
    assert {} == csplat.decode(data).extra == csplat.decode(tmp_path / "a.csplat").extra
    kept = encode_with_report(model, EncodeOptions(keep_extra=True))
    assert (["object_id"], ()) == (list(csplat.decode(kept.data).extra), kept.report.notes)
    assert {} == csplat.read(tmp_path / "a.ply", keep_extra=False).extra


def test_long_features_take_several_columns_and_other_types_are_refused(make_model, tmp_path):
    feature = np.random.default_rng(0).normal(size=(20, 512)).astype(np.float32)
    with pytest.raises(InputError, match=r"shape \(20, 512\), .*: split it into columns 'clip', 'clip_64' and"):
        make_model(20, extra={"clip": feature})
    columns = {f"clip_{at}" if at else "clip": feature[:, at : at + 64] for at in range(0, 512, 64)}
    csplat.write_ply(tmp_path / "a.ply", make_model(20, 0, extra=columns))
    decoded, result = round_trip(csplat.read(tmp_path / "a.ply"), keep_extra=True)
    assert list(columns) == list(decoded.extra)
    assert np.array_equal(feature[result.source_index], np.hstack(list(decoded.extra.values())))
    for dtype in (np.float16, np.int64):
        with pytest.raises(InputError, match=f"'c' is {np.dtype(dtype)}, expected uint8, .*float64: convert it by ast"):
            round_trip(make_model(20, 0, extra={"c": np.zeros(20, dtype)}), keep_extra=True)


def test_extra_columns_of_several_components_and_semantics_decode(make_model):
    random = np.random.default_rng(1)
    columns = {
        "normal": random.normal(size=(30, 3)).astype(np.float32), "most": random.integers(0, 9, (30, 64), np.int16),
        "one": np.arange(30, dtype=np.uint32), "big": random.normal(size=(30, 2)).astype(">f8"),
    }  # fmt: skip
    semantics = {"normal": "normal", "most": "feature:größe", "one": "_mine"}
    decoded, result = round_trip(make_model(30, 1, extra=columns, semantics=semantics), keep_extra=True)
    assert semantics == decoded.metadata.semantics
    for name, column in columns.items():
        assert np.array_equal(column[result.source_index], decoded.extra[name]), name
    for wrong, words in (("s" * 57, "0 to 56 bytes"), ("a\nb", "control characters")):
        with pytest.raises(InputError, match=f"the semantic of extra column 'one' is invalid, expected .*{words}"):
            round_trip(make_model(30, extra=columns, semantics={"one": wrong}), keep_extra=True)
    for shape in ((30, 1), (30, 65), (30, 2, 2), (29, 2)):
        with pytest.raises(InputError, match=r"'c' has shape .*, expected \(30,\) or \(30, 2\) to \(30, 64\)"):
            make_model(30, extra={"c": np.zeros(shape)})


def test_sh_degree_drops_bands_and_declares_their_error(make_model):
    # SER-6
    for degree, kept, dropped in ((3, 1, {"sh2", "sh3"}), (4, 3, {"sh4"})):
        model = make_model(200, degree)
        decoded, result = round_trip(model, sh_degree=kept)
        assert kept == decoded.sh_degree
        for name in dropped:
            band = model.shN[:, int(name[2]) ** 2 - 1 : (int(name[2]) + 1) ** 2 - 1]
            assert float(np.abs(band).max()) == pytest.approx(result.report.errors[name][0], rel=1e-4)
        assert f"sh{degree + 1}" not in result.report.errors


def test_band_4_of_few_splats_is_sparse(make_model):
    model = make_model(2000, 4)
    few = np.zeros_like(model.shN)
    few[::100, 15:] = model.shN[::100, 15:]
    decoded, result = round_trip(replace(model, shN=few), sh_coding="scalar")
    assert 4 == decoded.sh_degree
    layers = csplat.read_header(result.data).tiles[0].layers
    assert {0, 4} == {*layers}  # the other bands are zeros
    assert layers[4].size < 2000


@pytest.mark.slow
def test_the_id_of_shape_codebooks_does_not_depend_on_the_degree(make_model):
    # Files of degree 3 keep their bytes.
    for degree in (3, 4):
        model, nine = make_model(600, degree), np.arange(600) % 9
        shapes = replace(model, quats=model.quats[nine], scales=model.scales[nine])
        data = encode(shapes, EncodeOptions(sh_coding="codebook", codebook_size=16, shape_codebook_size=64))
        assert [0, 4] == [record.codebook_id for record in csplat.read_header(data).codebooks]


def test_means_are_as_near_as_their_bits_or_float32_allow(make_model):
    model = make_model(300, 0)
    extent, rounding = float(np.ptp(model.means, axis=0).max()), np.spacing(np.abs(model.means).max())
    for bits in (4, 10, 16):
        decoded, result = round_trip(model, position_bits=bits)
        error = np.abs(decoded.means - model.means[result.source_index]).max()
        assert extent * 2.0 ** -(bits + 2) <= float(error) <= extent * 2.0**-bits + rounding
    far, point = model.means * 50 + np.float32(1e7), np.full((300, 3), 3.14159, np.float32)
    for means in (far, point):
        decoded, result = round_trip(replace(model, means=means), position_bits=16)
        assert np.abs(decoded.means - means[result.source_index]).max() <= np.spacing(means.max())
    with_origin, _ = round_trip(replace(model, origin=(1e7, -1e7, 1e7)))
    np.testing.assert_array_equal(round_trip(model)[0].means, with_origin.means)


def test_values_on_a_grid_of_powers_of_two_are_exact(make_model):
    model = make_model(300, 0)
    means, scales = np.rint(model.means * 1024) / 1024, np.rint(model.scales * 16) / 16
    decoded, result = round_trip(replace(model, means=means, scales=scales), attribute_psnr=80)
    np.testing.assert_array_equal(decoded.means, means[result.source_index])
    np.testing.assert_array_equal(np.sort(decoded.scales), np.sort(scales[result.source_index]))
    assert (2.0**-10, 2.0**-4) == tuple(result.report.options[name] for name in ("position_step", "scale_step"))

    means[-1, 2] += np.spacing(means[-1, 2])
    _, off = round_trip(replace(model, means=means, scales=scales), attribute_psnr=80)
    assert off.report.options["position_step"] < 2.0**-10
    _, coarse = round_trip(replace(model, means=means, scales=scales), preset="small")
    assert coarse.report.options["scale_step"] > 2.0**-4


def test_an_outlier_does_not_change_the_precision_of_others(make_model):
    model = make_model(1000, 0)
    step = encode_with_report(model).report.options["position_step"]
    for far in (1e3, 1e12, 3e38):
        means = np.concatenate([model.means, [[far, 0, 0]]]).astype(np.float32)
        decoded, result = round_trip(replace(model.select(np.append(np.arange(1000), 0)), means=means))
        errors = np.abs(decoded.means - means[result.source_index])[result.source_index < 1000]
        assert float(errors.max()) <= 0.5 * step * 1.01


magnitudes = st.sampled_from([1e-38, 1e-30, 1e-7, 1e-3, 1.0, 1e3, 1e7, 1e20, 1e30, 1e38])


@st.composite
def wild_models(draw):
    """Draw models whose magnitudes span the range of float32."""
    count = draw(st.integers(0, 12))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))

    def wild(*shape: int) -> np.ndarray:
        chosen = np.array(draw(st.lists(magnitudes, min_size=1, max_size=3)))
        values = rng.standard_normal((count, *shape)) * rng.choice(chosen, (count,) + (1,) * len(shape))
        return np.clip(values, -3e38, 3e38).astype(np.float32)

    return SplatModel(
        means=wild(3), quats=csplat.model.normalise_quats(wild(4)), scales=np.clip(wild(3), -60, 60),
        opacities=rng.random(count).astype(np.float32), sh0=wild(3), shN=wild((draw(st.integers(1, 4))) ** 2 - 1, 3),
    )  # fmt: skip


@pytest.mark.slow
@given(wild_models(), st.sampled_from(PRESET_NAMES), st.sampled_from(["scalar", "codebook"]))
@settings(max_examples=40, suppress_health_check=list(HealthCheck))
def test_mixtures_of_magnitudes_decode_or_are_refused(model, preset, coding):
    # CNF-6
    with suppress(InputError):
        round_trip(model, preset=preset, sh_coding=coding)


def test_bytes_do_not_depend_on_threads(make_model):
    # CNF-10
    for coding in ("scalar", "codebook"):
        options = {"sh_coding": coding, "tile_splats": 150, "codebook_size": 32}
        one, four = (encode(make_model(600, 2), EncodeOptions(**options), context=Context(threads=n)) for n in (1, 4))
        assert bool(one == four)


OUT_OF_RANGE = (
    ("preset", "tiny"), ("position_bits", 17), ("position_bits", 8.5), ("sh_degree", 5), ("quat_levels", 2),
    ("deflate_level", 0), ("scale_step", 0), ("scale_step", math.nan), ("sh_step", "0.1"),
    ("tile_splats", 0), ("bucket_splats", None),
)  # fmt: skip


def test_options_are_scalars_of_python_or_numpy_within_their_range(make_model):
    for name, value in OUT_OF_RANGE:
        with pytest.raises(InputError, match=name):
            EncodeOptions(**{name: value})
    options = EncodeOptions(position_bits=np.int64(12), scale_step=np.float32(0.25), sh_step=np.float64(0.1))
    same, model = EncodeOptions(position_bits=12, scale_step=0.25, sh_step=0.1), make_model(20, 1)
    assert encode(model, options) == encode(model, same)


@pytest.mark.slow
def test_invalid_importances_and_metadata_are_refused(make_model):
    ten = (-np.ones(10), np.full(10, np.nan), np.ones(10, complex), np.full(10, "1"), np.zeros(10, "M8[s]"))
    for bad in (np.ones(3), *ten):
        with pytest.raises(InputError, match="importance"):
            encode_with_report(make_model(10, 1), importance=bad)
    large = " " * (_spec.BUDGET_JSON_BYTES // _spec.JSON_BYTE_COST)
    for value, message in (({1, 2}, "JSON"), (large, "more than decoders accept by default: store fewer, or none")):
        with pytest.raises(InputError, match=message):
            encode(make_model(3, 0, entries={"title": value}))


def test_important_splats_have_smaller_errors(make_model):
    model, favoured = make_model(600, 2), np.arange(600) < 60
    for least, coding in ((1e-6, "codebook"), (0.0, "scalar")):
        decoded, result = round_trip(model, np.where(favoured, 1.0, least), preset="small", sh_coding=coding)
        errors = ((decoded.shN - model.shN[result.source_index]) ** 2).sum(axis=(1, 2))
        chosen = favoured[result.source_index]
        assert float(errors[chosen].mean()) < 0.5 * float(errors[~chosen].mean())
    assert float(errors[~chosen].mean()) < float((model.shN**2).sum(axis=(1, 2)).mean())


@pytest.mark.slow
def test_coarse_chroma_does_not_wrap_at_the_end_of_its_type(make_model):
    importance = np.where(np.arange(300) < 60, 1.0, 1e-8)
    for shift, reach in itertools.product((0, 1, 2), (0.62, 163.8)):
        model = make_model(300, 1)
        model.shN[:] = np.clip(model.shN * reach, -reach, reach)
        model.shN[:, :, 2] = -model.shN[:, :, 0]
        round_trip(model, importance, preset="fast", chroma_shift=shift, sh_step=0.01, adaptive=1.0)


def test_transparent_splats_keep_their_sh_and_do_not_prevent_a_codebook(make_model):
    for coding in ("codebook", "scalar"):
        model = make_model(300, 2, opacities=np.zeros(300, np.float32))
        assert round_trip(model, preset="small", sh_coding=coding, adaptive=1.0)[0].shN.any()
    model = make_model(600, 2)
    model.shN[5], model.opacities[5] = 1e3, 0.0
    decoded, result = round_trip(model, sh_coding="codebook", escape_fraction=0.0)
    assert "codebook" == result.report.options["sh_coding"]
    place = int(np.flatnonzero(result.source_index == 5)[0])
    assert np.abs(decoded.shN[place] - 1e3).max() < 1.0  # clipped for the clustering, it is coded as an escape


def test_the_report_has_options_metadata_and_progress_of_each_stage(make_model):
    seen, metadata = {}, {"simplified": {"why": "a test"}, "more": 7}
    options = EncodeOptions(preset="small", sh_coding="codebook", tile_splats=100)
    plan = EncodePlan.of(make_model(500, 2), options, context=Context(seed=7, progress=seen.__setitem__))
    result = encode_planned(plan, metadata=metadata)
    recorded = read_options(result.data)
    asked = {"preset": "small", "sh_coding": "codebook", "tile_splats": 100}
    assert result.report.options == recorded == recorded | metadata | {"asked": asked, "seed": 7}
    assert {"codebook": 1.0, "tiles": 1.0} == seen


def test_huge_sh_get_tiles_of_their_own_with_a_note_and_are_coded_as_scalars(make_model):
    model = make_model(300, 1)
    assert () == encode_with_report(model).report.notes
    rest = model.shN.copy()
    rest[5] = 1e9
    result = encode_with_report(replace(model, shN=rest), EncodeOptions(sh_coding="scalar"))
    (note,) = result.report.notes
    assert note.startswith("shN: huge values coarsen 1 of 2 tiles")
    others = result.source_index != 5
    error = np.abs(csplat.decode(result.data).shN - rest[result.source_index])[others]
    assert error.max() <= encode_with_report(model, EncodeOptions(sh_coding="scalar")).report.errors["sh1"][0]
    model = make_model(600, 2)
    model.shN[5] = 3e38
    assert "scalar" == round_trip(model, preset="small")[1].report.options["sh_coding"]
    with pytest.raises(InputError, match="use scalar SH coding"):
        encode_with_report(model, EncodeOptions(preset="small", sh_coding="codebook"))


def test_zlib_replaces_an_absent_libdeflate(make_model, monkeypatch):
    monkeypatch.setitem(sys.modules, "deflate", None)
    monkeypatch.setattr("importlib.util.find_spec", lambda _name: None)
    assert "zlib" == round_trip(make_model(50, 1))[1].report.options["deflate"]
    with pytest.raises(InputError, match="deflate"):
        encode(make_model(5, 0), EncodeOptions(deflate="libdeflate"))
