"""The public verbs, one module for those that go together; `keyss.api` has their names."""
