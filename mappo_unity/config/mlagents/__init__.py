"""ML-Agents' configurations: its YAML file and its flags, read and translated into options of ours.

`keys` lists every key, `yaml_lines` reads a file with its line numbers, `flags` the command line, `read`
checks and merges both, `translate` makes option lines, `unnamed` is about what a run has that the file does
not name, `ineffective` about flags without effect, `resolved` what configuration.yaml holds.
"""
