"""Files shipped with the package: the embedded body and its licence."""
