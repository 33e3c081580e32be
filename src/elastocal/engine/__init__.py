"""The linear mixed model that identification and diagnosis share."""
