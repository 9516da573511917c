"""Results on disk: manifests, claimed folders, atomic writes, locks, records and digests."""
