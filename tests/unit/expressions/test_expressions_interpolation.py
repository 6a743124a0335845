"""`${…}` fills values into fields: alone with their type, inside text as text, never evaluated twice."""

import json

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from wayside.expressions import CelType, Environment, InterpolationError, Json, compile_template

ENVIRONMENT = Environment({"parameters": CelType.MAP, "instance": CelType.MAP})
VALUES: dict[str, object] = {
    "parameters": {
        "replicas": 3,
        "rate": 2.5,
        "region": "north",
        "sources": ["car1", "car2"],
        "options": {"b": 1, "a": None},
        "nothing": None,
        "on": True,
        "shell": "${parameters.replicas} $${x}",
        "huge": 2.0**80,
        "nan": float("nan"),
        "items": [1, None, 2.5],
    },
    "instance": {"name": "fusion-1"},
}


def render(template: Json, *, integers: bool = True) -> Json:
    return compile_template(template, ENVIRONMENT, path="spec").render(VALUES, integers=integers)


def refusal(template: Json) -> InterpolationError:
    with pytest.raises(InterpolationError) as caught:
        render(template)
    return caught.value


@pytest.mark.parametrize(
    ("template", "expected"),
    [
        ("${parameters.replicas}", 3),
        ("${parameters.rate}", 2.5),
        ("${parameters.on}", True),
        ("${parameters.sources}", ["car1", "car2"]),
        ("${parameters.options}", {"a": None, "b": 1}),
        ("${parameters.items}", [1, None, 2.5]),
        ("${parameters.nothing}", None),
        ("${ parameters.replicas * 2 }", 6),
        ("${parameters.huge}", 2.0**80),
    ],
)
def test_a_single_expression_keeps_the_type_of_its_value(template: str, expected: Json) -> None:
    result = render(template)
    assert result == expected
    assert type(result) is type(expected)
    assert json.dumps(result) == json.dumps(expected)


@pytest.mark.parametrize(
    ("template", "expected"),
    [
        ("n=${parameters.replicas}", "n=3"),
        ("${parameters.rate}Hz", "2.5Hz"),
        ("${instance.name}-${parameters.region}", "fusion-1-north"),
        ("is ${parameters.on}", "is true"),
        ("--sources=${parameters.sources}", '--sources=["car1","car2"]'),
        ("${parameters.options}\n", '{"a":null,"b":1}\n'),
        (" ${parameters.replicas}", " 3"),
        ("é${parameters.sources.map(s, s + 'ü')}", 'é["car1ü","car2ü"]'),
    ],
)
def test_inside_text_a_value_becomes_text(template: str, expected: str) -> None:
    assert render(template) == expected
    assert render(template, integers=False) == expected


def test_null_drops_the_field() -> None:
    template: Json = {
        "a": "${parameters.nothing}",
        "b": ["${parameters.nothing}", "x"],
        "c": {"d": "${parameters.nothing}"},
    }
    assert render(template) == {"b": ["x"], "c": {}}
    assert render({"kept": None, "list": [None]}) == {"kept": None, "list": [None]}


def test_integral_doubles_become_integers_only_where_wanted() -> None:
    template: Json = {"replicas": "${parameters.replicas}", "weights": [1.0, 2.5], "options": "${parameters.options}"}
    assert json.dumps(render(template)) == '{"replicas": 3, "weights": [1, 2.5], "options": {"a": null, "b": 1}}'
    assert json.dumps(render(template, integers=False)) == (
        '{"replicas": 3.0, "weights": [1.0, 2.5], "options": {"a": null, "b": 1.0}}'
    )


@pytest.mark.parametrize(
    ("template", "expected"),
    [
        ("echo $${HOME}", "echo ${HOME}"),
        ("$${a}${parameters.replicas}$${b}", "${a}3${b}"),
        ("$$${x}", "$${x}"),
        ("$HOME $(pwd) {} }", "$HOME $(pwd) {} }"),
        ("$", "$"),
        ("", ""),
        ("$${", "${"),
    ],
)
def test_two_dollars_write_a_literal(template: str, expected: str) -> None:
    assert render(template) == expected


@pytest.mark.parametrize(
    ("template", "expected"),
    [
        ('${ {"a": "}"}["a"] }', "}"),
        ("${'}' + \"}\" + r'\\}' + '''}'''}", "}}\\}}"),
        ("${'${'}", "${"),
        ("x${ {'a': {'b': 1}}.a.b }y", "x1y"),
        ("${[1, 2].map(x, {'v': x})}", [{"v": 1}, {"v": 2}]),
    ],
)
def test_braces_are_matched_with_strings_respected(template: str, expected: Json) -> None:
    assert render(template) == expected


def test_values_are_never_evaluated_again() -> None:
    assert render("${parameters.shell}") == "${parameters.replicas} $${x}"
    assert render("a ${parameters.shell}") == "a ${parameters.replicas} $${x}"


def test_keys_become_text() -> None:
    assert render({"${instance.name}": 1, "n-${parameters.replicas}": 2, "$${x}": 3}) == {
        "fusion-1": 1,
        "n-3": 2,
        "${x}": 3,
    }
    assert refusal({"${instance.name}": 1, "fusion-1": 2}).message == "two keys render to 'fusion-1'"


def test_names_and_paths_cover_all_expressions() -> None:
    compiled = compile_template({"a": ["${instance.name}"], "${parameters.region}": "x"}, ENVIRONMENT)
    assert compiled.names == {"instance", "parameters"}
    assert compiled.paths == {("instance", "name"), ("parameters", "region")}
    assert [each.path for each in compiled.embedded] == ["a[0]", '["${parameters.region}"]']


@pytest.mark.parametrize(
    ("template", "path", "place", "message", "hint"),
    [
        (
            {"run": "#!/bin/sh\necho ${HOME}"},
            "spec.run",
            (2, 8),
            "`HOME` is not declared here",
            "write `$${` for a literal",
        ),
        ("${FOO:-bar}", "spec", (1, 6), "unexpected `:`", "write `$${` for a literal"),
        ("a ${instance.name", "spec", (1, 3), "`${` is not closed", "write `$${` for a literal"),
        ("${it's} 'x", "spec", (1, 1), "`${` is not closed", "write `$${` for a literal"),
        ("a${}", "spec", (1, 4), "the expression is empty", "write `$${` for a literal"),
        ("${parameter.x}", "spec", (1, 3), "`parameter` is not declared here", "did you mean `parameters`?"),
        ("x\n${parameters.x +\n nobody}", "spec", (3, 2), "`nobody` is not declared here", "write `$${`"),
        ([{"a": ["", "${nobody}"]}], "spec[0].a[1]", (1, 3), "`nobody` is not declared here", "write `$${`"),
        (
            {"wayside.dev/x": "${nobody}"},
            'spec["wayside.dev/x"]',
            (1, 3),
            "`nobody` is not declared here",
            "write `$${`",
        ),
        ("${parameters.regoin}", "spec", (1, 3), "there is no `parameters.regoin`; did you mean `region`?", None),
        ("a\n ${parameters.region - 1}", "spec", (2, 4), "`-` does not take a string and a number", None),
        ("is ${parameters.nothing}", "spec", (1, 6), "`parameters.nothing` is null inside a string", "x == null"),
        ("${parameters.nan}", "spec", (1, 3), "yields nan, which JSON cannot represent", None),
        ("${parameters.replicas / 0}", "spec", (1, 3), "yields inf, which JSON cannot represent", None),
        ("${b'x'}", "spec", (1, 3), "yields bytes, which JSON cannot represent", None),
    ],
)
def test_errors_name_the_field_the_place_and_the_remedy(
    template: Json, path: str, place: tuple[int, int], message: str, hint: str | None
) -> None:
    error = refusal(template)
    assert (error.path, (error.line, error.column)) == (path, place)
    assert message in error.message
    assert hint is None or (error.hint is not None and hint in error.hint)
    assert str(error).startswith(f"{path}, line {place[0]}, column {place[1]}: ")
    assert "\n" not in str(error)


def test_all_errors_of_a_template_are_reported() -> None:
    error = refusal({"a": "${nobody}${nothing}", "b": ["${", "${instance.name}"], "c": "${1 +}"})
    assert [each.path for each in (error, *error.others)] == ["spec.a", "spec.a", "spec.b[0]", "spec.c"]


_TEXT = st.text().filter(lambda text: "${" not in text)
_FIELDS = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | _TEXT,
    lambda below: st.lists(below, max_size=4) | st.dictionaries(_TEXT, below, max_size=4),
    max_leaves=20,
)


@given(_FIELDS)
def test_fields_without_expressions_render_to_themselves(fields: Json) -> None:
    assert render(fields, integers=False) == fields


@given(st.text())
def test_any_text_can_be_written_literally(text: str) -> None:
    if "$${" not in text:
        assert render(text.replace("${", "$${")) == text


@given(st.text().filter(lambda text: "\0" not in text))
@settings(max_examples=100)
def test_any_value_is_rendered_unchanged(value: str) -> None:
    for template, expected in (("${parameters.v}", value), ("<${parameters.v}>", f"<{value}>")):
        assert compile_template(template, ENVIRONMENT).render({"parameters": {"v": value}}) == expected


@given(st.text(alphabet="${}parameters.region\"' \n", max_size=40))
@settings(max_examples=200)
def test_any_text_renders_or_is_refused(text: str) -> None:
    try:
        render(text)
    except InterpolationError as error:
        assert error.path == "spec"  # noqa: PT017
        assert 1 <= error.line <= text.count("\n") + 1  # noqa: PT017
