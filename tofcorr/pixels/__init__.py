"""Which pixels and frames count, and how much: data sets, masks, splits, samples and errors."""
