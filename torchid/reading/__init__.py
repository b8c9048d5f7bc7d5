"""From log files to samples of a robot: whole, in blocks where they are larger than memory, or out of a cache.

- a log: `log_reader`; larger than memory `large_log`, in segments `segmented_log`
- the cache of samples and factors: `cached_reader`, `cache_entries`, `cache`
- several processes that read one log together: `shared_log`
"""
