"""The check of `tofcorr diagnose` on recordings whose effect is withheld from it.

`generator` draws scenes from raw sensor physics and shares nothing with `tofcorr`; `cases` writes
recordings and, apart, sealed answers; `diagnose` runs the installed program on the recordings
alone; `scoring` opens the answers.
"""
