"""Pictures of one view: under a slider on a screen, side by side on paper or without scripts."""

from __future__ import annotations

from keyss.report.markup import Html, element
from keyss.report.reading import Part, Picture, Pictures


def comparison(group: Part, pictures: Pictures) -> Html | None:
    """Pictures of the same view, which slider.js turns into a slider. Raises InputError."""
    title = group.text("title") or "Pictures"
    shots = [
        (item.text("label") or "picture", picture)
        for item in group.parts("items", 20)
        if (picture := pictures.read(item, "file")) is not None
    ]
    if not shots:
        return None
    labels = [label for label, _ in shots]
    slider = len(shots) > 1
    return element(
        "figure",
        element("figcaption", title),
        element(
            "div",
            *(_shot(title, label, picture) for label, picture in shots),
            _range(title) if slider else None,
            element("span", class_="handle", aria_hidden="true") if slider else None,
            class_="stage",
            style=f"--aspect:{_aspect(shots[0][1])}",
        ),
        _choices(title, labels) if slider else None,
        class_="compare",
    )


def captioned(picture: Picture, caption: str) -> Html:
    """A picture with a line below it."""
    return element("figure", _image(picture, caption), element("figcaption", caption))


def _shot(title: str, label: str, picture: Picture) -> Html:
    return element(
        "div", _image(picture, f"{title}: {label}"), element("span", label, class_="label"), class_="shot"
    )


def _image(picture: Picture, alt: str) -> Html:
    return element("img", src=picture.url, alt=alt, width=str(picture.width), height=str(picture.height))


def _range(title: str) -> Html:
    return element(
        "input",
        type="range",
        min="0",
        max="100",
        value="50",
        step="1",
        aria_label=f"{title}: move the border",
    )


def _choices(title: str, labels: list[str]) -> Html:
    return element(
        "div",
        element("label", "left ", _select(f"{title}: left picture", labels, 0)),
        element("label", "right ", _select(f"{title}: right picture", labels, 1)),
        element("label", element("input", type="checkbox"), " difference, 4 times as bright"),
        class_="choices",
    )


def _select(name: str, labels: list[str], chosen: int) -> Html:
    options = [
        element("option", label, value=str(index), selected=index == chosen)
        for index, label in enumerate(labels)
    ]
    return element("select", *options, aria_label=name)


def _aspect(picture: Picture) -> str:
    return f"{picture.width / picture.height:.4f}"
