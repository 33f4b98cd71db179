"""Which terms stand for all in the tests of every day: between them they have every measure and every density."""


def first_of_their_kind(terms: dict) -> set[str]:
    """Names of terms with a measure or a density that none before them has."""
    seen, result = set(), set()
    for name, term in terms.items():
        kinds = {term.measure.name, term.density.name}
        if kinds - seen:
            result.add(name)
        seen |= kinds
    return result
