"""ML-Agents' configurations: its YAML file and its flags, read and translated into options of ours.

`yaml_lines` reads a file with its line numbers, `flags` the command line, `keys` lists every key, `read` checks
and merges, `translate` makes option lines.
"""
