"""Names of scenes in messages."""

from __future__ import annotations

from keyss.methods.method import role_of, role_phrase


def test_role_phrase_has_an_article_only_without_a_number() -> None:
    phrases = [role_phrase(role_of(index, scenes)) for index, scenes in ((0, 3), (1, 2), (1, 3), (12, 13))]
    assert phrases == ["the cover", "the secret", "secret 1", "secret 12"]
