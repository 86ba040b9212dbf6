//! The map of points: storage, queries, ageing.
