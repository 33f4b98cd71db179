"""Prose lint: count breaches of the house's rules for docstrings, comments, names, the README and the site, against a baseline.

    python tools/lint_prose.py [PATH ...]     compare counts with tools/lint_prose.json; exit 1 where one has grown
    python tools/lint_prose.py --list D1 [PATH ...]   print every finding of a rule (or of `all`)
    python tools/lint_prose.py --update       write counts that have fallen to the baseline; refuse counts that have grown

Docstrings and comments of every Python file are read; text in backticks, doctests and literal blocks are left out. Counts are
kept by rule and top folder. A rule with a count of 0 in the baseline reports each finding.

D1  docstring that opens with a pronoun, a preposition, a relative clause or a back reference
D2  docstring of a function in the third person ("Returns", not "Return")
D3  pronoun or relative clause in the first clause
D4  docstring that opens with a call
S1  sentence of more than 30 words
S2  sentence with more than one semicolon
W*  words that have no technical meaning, or several; the table WORDS lists the term of the field instead
N1  local names and arguments that say nothing (`given`, `found`, `at`, ...)
R*  rules D3, S1 and the words in the README and the pages of the site
"""

import argparse
import ast
import io
import json
import re
import sys
import tokenize
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
BASELINE = ROOT / "tools" / "lint_prose.json"
FOLDERS = ("kernels", "ddg_warp", "scenes", "tools", "tests")

OPENINGS = re.compile(
    r"^(What|Whose|Who|Which|Whether|Where|When|How|Of|As|By|In|At|On|From|To|With|Than|That|Those|These|This|It|Its|They|Their|Such|"
    r"Nothing|Both|So|Else|Beside|Beyond|Around|Before|After|The (same|rest|others?)|All (of|but)|None of)\b"
)
THIRD_PERSON = re.compile(
    r"^(Adds|Writes|Takes|Puts|Makes|Keeps|Asks|Finds|Starts|Raises|Marks|Notes|Decides|Lowers|Lists|Sums|Gathers|Places|Replaces|Links|"
    r"Owns|Reads|Steps|Serves|Shortens|Advances|Solves|Ends|Sends|Tells|Says|Gives|Has|Goes|Lets|Cuts|Refuses|Returns|Moves|Holds|Turns|"
    r"Counts|Zeroes|Leaves|Excuses)\b"
)
PRONOUN = re.compile(r"\b(they|them|their|these|those|it|its|one that|ones|which|whose|what)\b", re.I)
CALL = re.compile(r"^[a-z_]+\(.*?\)")
LONG = 30  # words of a sentence

# rule -> (pattern, the terms to use instead)
WORDS = {
    "W1": (r"\bthings?\b", "primitive, element, dof, object"),
    "W2": (r"\b(told|tells?)\b", "given, stated, reported"),
    "W3": (r"\bways\b|\b(on (the|its|their)|its|their|long|short|whole) way\b", "motion, path"),
    "W4": (r"\b(beside|anew|onward)\b", "next to, again, further"),
    "W5": (r"\brub(s|bed|bing)?\b", "friction"),
    "W6": (r"\bjudge[sd]?\b", "line search, test"),
    "W7": (r"\bfores(ee|een|ight)\b", "warm start"),
    "W8": (r"\bdrown(s|ed)?\b", "below the rounding floor"),
    "W9": (r"\bbarred\b|\bidle\b", "inactive"),
    "W10": (r"\b(patience|detours?|warily|cautious)\b", "limit, projected iteration"),
    "W11": (r"\bcrowds?\b", "many bodies in contact"),
    "W12": (r"\b(rests|resting)\b", "sleeping, lies at rest"),
    "W13": (r"\bshares?\b", "step fraction, weight"),
    "W14": (r"\bslots?\b", "local node index"),
    "W15": (r"(?<!in )\bplaces?\b", "index, position, path node"),
    "W16": (r"\bheld\b", "fixed, prescribed"),
    "W17": (r"\b(brings?|brought)\b", "contributes, adds"),
    "W18": (r"\bpush(es|ed)?\b|\btouch(es|ed|ing)?\b", "in contact"),
    "W19": (r"\bnets?\b", "coupled system"),
    "W20": (r"(?<!hanging )\bchains?\b", "rod group, rod path, substructuring"),
    "W21": (r"\bwhat\b", "name the noun"),
    "W22": (r"\bturn(s|ed|ing)?\b", "rotate, rotation"),
    "W23": (r"\bparts?\b", "name the part"),
    "W24": (r"\bthose\b", "repeat the noun"),
    "W25": (r"\blook(s|ed)?\b|\basks?\b|\basked\b", "query, request, check"),
}
PATTERNS = {rule: re.compile(pattern, re.I) for rule, (pattern, _instead) in WORDS.items()}
NAMES = re.compile(
    r"^(own\d?|found|given|at|here|there|told|known|things?|ways?|what|which|others?|now|then|beside|anew|ahead|behind|late|onward|apart|"
    r"held|bad|met|felt|seen|put|of|by)$"
)
RULES = ("D1", "D2", "D3", "D4", "S1", "S2", *WORDS, "N1", "R")


@dataclass(frozen=True, order=True)
class Finding:
    """A breach of a rule at a line of a file."""

    path: str
    line: int
    rule: str
    text: str

    def __str__(self) -> str:
        return f"{self.path}:{self.line}: {self.rule}: {self.text}"


def plain(text: str) -> str:
    """Return prose without backticks, doctests, indented literal blocks and equations."""
    text = re.sub(r"`[^`]*`", "`x`", text)
    lines = text.split("\n")
    body = [line for line in lines[1:] if line.strip()]
    margin = min((len(line) - len(line.lstrip()) for line in body), default=0)
    kept, literal = [lines[0]], False
    for line in lines[1:]:
        deep = len(line) - len(line.lstrip()) - margin
        after_blank = not kept[-1].strip() and line.strip()
        if after_blank:
            literal = deep >= 4
        kept.append("" if literal or line.lstrip().startswith((">>>", "...")) else line)
    return "\n".join(kept)


def sentences(text: str) -> Iterator[str]:
    """Yield the sentences of prose: paragraphs, list items and table rows end one, too."""
    for paragraph in re.split(r"\n\s*\n|\n\s*(?=[-*|] )|\n\s*(?=\w+: )", text):
        yield from re.split(r"(?<=[.!?])\s+(?=[A-Z`(])", " ".join(paragraph.split()))


def words(sentence: str) -> int:
    """Return the number of words of a sentence, numbers and symbols left out."""
    return sum(any(c.isalpha() for c in word) for word in sentence.split())


def first_clause(text: str) -> str:
    """Return the first clause of a docstring, up to the first comma, colon, semicolon or full stop."""
    return re.split(r"[,:;.](?:\s|$)", text.strip(), maxsplit=1)[0]


def docstrings(tree: ast.AST) -> Iterator[tuple[ast.AST, int, str]]:
    """Yield (definition, line, text) of every docstring."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            text = ast.get_docstring(node, clean=False)
            if text:
                yield node, node.body[0].lineno, text


def comments(source: str) -> Iterator[tuple[int, str]]:
    """Yield (line, text) of every block of comments."""
    block, start, last = [], 0, -1
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type != tokenize.COMMENT:
            continue
        line, trailing = token.start[0], token.line[: token.start[1]].strip() != ""
        if line != last + 1 or trailing or not block:
            if block:
                yield start, "\n".join(block)
            block, start = [], line
        block.append(token.string.lstrip("# "))
        last = -1 if trailing else line
    if block:
        yield start, "\n".join(block)


def prose_findings(path: str, line: int, text: str, rules=tuple(WORDS)) -> Iterator[Finding]:
    """Yield findings of sentence lengths, semicolons and words in a text."""
    prose = plain(text)
    for sentence in sentences(prose):
        if words(sentence) > LONG:
            yield Finding(path, line, "S1", sentence[:90])
        if sentence.count(";") > 1:
            yield Finding(path, line, "S2", sentence[:90])
    for rule in rules:
        for match in PATTERNS[rule].finditer(prose):
            at_line = line + prose[: match.start()].count("\n")
            yield Finding(path, at_line, rule, f"{match.group()!r}: {WORDS[rule][1]}")


def names(tree: ast.AST) -> Iterator[tuple[int, str]]:
    """Yield (line, name) of every local or argument that says nothing."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store) and NAMES.match(node.id):
            yield node.lineno, node.id
        elif isinstance(node, ast.arg) and NAMES.match(node.arg):
            yield node.lineno, node.arg


def lint_source(path: str, source: str) -> list[Finding]:
    """Return all findings of a Python file."""
    tree = ast.parse(source)
    result = []
    for node, line, text in docstrings(tree):
        opening = text.strip()
        if OPENINGS.match(opening):
            result.append(Finding(path, line, "D1", opening[:90]))
        if isinstance(node, ast.FunctionDef) and THIRD_PERSON.match(opening):
            result.append(Finding(path, line, "D2", opening[:90]))
        if PRONOUN.search(plain(first_clause(opening))):
            result.append(Finding(path, line, "D3", first_clause(opening)[:90]))
        if CALL.match(opening):
            result.append(Finding(path, line, "D4", opening[:90]))
        result += prose_findings(path, line, text)
    for line, text in comments(source):
        if not text.startswith(("noqa", "type:", "!/")):
            result += prose_findings(path, line, text)
    result += [Finding(path, line, "N1", name) for line, name in names(tree)]
    return result


def lint_page(path: str, text: str) -> list[Finding]:
    """Return findings of a page's prose, all as rule R; code blocks and tables are left out."""
    prose = re.sub(r"```.*?```", lambda m: "\n" * m.group().count("\n"), text, flags=re.S)
    prose = "\n".join("" if line.startswith(("|", "    ")) else line for line in prose.split("\n"))
    found = prose_findings(path, 1, prose, rules=[f"W{i}" for i in range(1, 13)])
    return [Finding(f.path, f.line, "R", f"{f.rule} {f.text}") for f in found]


def lint(paths: list[Path]) -> list[Finding]:
    """Return all findings of files and folders, in order."""
    result = []
    for path in paths:
        files = sorted([*path.rglob("*.py"), *path.rglob("*.md")]) if path.is_dir() else [path]
        for file in files:
            relative = file.resolve().relative_to(ROOT).as_posix() if file.resolve().is_relative_to(ROOT) else file.name
            text = file.read_text()
            result += lint_page(relative, text) if file.suffix == ".md" else lint_source(relative, text)
    return sorted(result)


def counts(findings: list[Finding]) -> dict[str, dict[str, int]]:
    """Return {rule: {top folder: count}} of findings, zeros included."""
    found = Counter((finding.rule, finding.path.partition("/")[0]) for finding in findings)
    table = {rule: {folder: found[rule, folder] for folder in FOLDERS} for rule in RULES[:-1]}
    table["R"] = {place: found["R", place] for place in ("README.md", "tools")}
    return table


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("paths", nargs="*", type=Path, help="files or folders to list findings of (default: all)")
    parser.add_argument("--list", metavar="RULE", help="print each finding of a rule, or of all")
    parser.add_argument("--update", action="store_true", help="write counts that have fallen to the baseline")
    arguments = parser.parse_args()
    everything = [*(ROOT / folder for folder in FOLDERS), ROOT / "README.md"]
    findings = lint(arguments.paths or everything)
    if arguments.list:
        print(*(f for f in findings if arguments.list in ("all", f.rule)), sep="\n")
        return 0
    table = counts(findings)
    if arguments.paths:
        print(*(f"{rule:4} {sum(row.values()):6}" for rule, row in table.items() if sum(row.values())), sep="\n")
        return 0
    known = json.loads(BASELINE.read_text()) if BASELINE.exists() else {}
    grown = [
        (rule, folder, known[rule][folder], number)
        for rule, row in table.items()
        for folder, number in row.items()
        if number > known.get(rule, {}).get(folder, number)
    ]
    for rule, folder, before, after in grown:
        print(f"{folder}: {rule} has grown from {before} to {after}: python tools/lint_prose.py --list {rule} {folder}")
        if before == 0:
            print(*(f for f in findings if f.rule == rule and f.path.startswith(folder)), sep="\n")
    if arguments.update and not grown:
        rows = ",\n".join(f'  "{rule}": {json.dumps(row)}' for rule, row in table.items())
        BASELINE.write_text("{\n" + rows + "\n}\n")
    return 1 if grown else 0


if __name__ == "__main__":
    sys.exit(main())
