"""`LineLocator`: where keys, tables and elements of a TOML text stand."""

import tomllib

from enact_dist.config.lines import LineLocator

TEXT = '''\
# comment = 1
a = 1
"b c" = [  # x = 2
  "]", # a comment with ] and "
  { d = 1, "e.f" = [2,
     3] },
]
long = """
g = 1
"quoted" \\""" end"""
raw = \'\'\'
h = 1\'\'\'

[t . "u v"]
i.j = 1
i.k = { l = "}", m = 2 }
[[n]]
o = 1
[[n]]
[n.p]
q = 1979-05-27T07:32:00Z
'''


def test_locator_finds_every_key_of_a_valid_text():
    """Keys in tables, arrays, inline tables and behind multi-line strings have their line."""
    tomllib.loads(TEXT)
    locator = LineLocator(TEXT)

    lines = {
        ("a",): 2,
        ("b c",): 3,
        ("b c", 0): 4,
        ("b c", 1): 5,
        ("b c", 1, "d"): 5,
        ("b c", 1, "e.f"): 5,
        ("b c", 1, "e.f", 1): 6,
        ("long",): 8,
        ("raw",): 11,
        ("t",): 14,
        ("t", "u v"): 14,
        ("t", "u v", "i", "j"): 15,
        ("t", "u v", "i", "k", "l"): 16,
        ("t", "u v", "i", "k", "m"): 16,
        ("n",): 17,
        ("n", 0, "o"): 18,
        ("n", 1): 19,
        ("n", 1, "p"): 20,
        ("n", 1, "p", "q"): 21,
    }
    assert {path: locator.line(path) for path in lines} == lines


def test_locator_gives_the_parent_when_a_key_is_absent():
    """A key that is missing is reported at its table, one without a table at the first line."""
    locator = LineLocator(TEXT)

    assert locator.line(("n", 1, "absent")) == 19
    assert locator.line(("g",)) == 1


def test_locator_reads_an_empty_text():
    """An empty file has one line."""
    assert LineLocator("").line(("name",)) == 1
