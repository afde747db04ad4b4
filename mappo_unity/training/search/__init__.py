"""Searches for good options: trials in several processes, chosen by Optuna, in a folder that can go on.

`checks` looks at everything before the first trial, `driver` hands trials to processes (`worker`), `study`
keeps them with Optuna, `table` says what came of them.
"""
