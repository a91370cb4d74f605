"""Pictures and the page of an import: scenes as they were cut."""
