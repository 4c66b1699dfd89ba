"""The decompression of PCD files, compiled."""

from roboarm_nmp.utils.numba_cache import compiled


@compiled
def decompress_lzf(compressed, result):
    """Write the bytes of LZF data (uint8) to `result`; returns how many, -1 if it is damaged."""
    i, n = 0, 0
    while i < compressed.shape[0]:
        control = int(compressed[i])
        i += 1
        if control < 32:  # so many bytes, and one more, as they are
            length = control + 1
            if i + length > compressed.shape[0] or n + length > result.shape[0]:
                return -1
            for _ in range(length):
                result[n] = compressed[i]
                i += 1
                n += 1
            continue
        length = control >> 5  # of a copy of what is already there
        if length == 7:
            if i >= compressed.shape[0]:
                return -1
            length += int(compressed[i])
            i += 1
        if i >= compressed.shape[0]:
            return -1
        begin = n - ((control & 31) << 8) - int(compressed[i]) - 1
        i += 1
        if begin < 0 or n + length + 2 > result.shape[0]:
            return -1
        for _ in range(length + 2):
            result[n] = result[begin]
            begin += 1
            n += 1
    return n
