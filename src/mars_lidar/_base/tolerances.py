"""Limits on the sizes that files may state, and sizes of blocks that are read and of texts that are shown."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Tolerances:
    """Constants of the base that are not arguments.

    Attributes
    ----------
    packed
        Times its size that the arrays of a file may take in memory: nothing that was ever recorded is smaller by so
        much when it is packed.
    least_in_parts, least_whole, small_file, most_of_small
        Bytes that a file of any size may take, read in parts and as a whole; bytes of a small file, and what such a
        one may take at most before it is refused.
    listed_chunks, chunk_entry
        Chunks that any HDF5 file may list; bytes of a file that each of more takes at least.
    slab_bytes
        Of a .npy in Fortran's order, read together.
    chunk_cache
        Bytes of HDF5's default chunk cache.
    nested
        Depth of groups within groups, or of matrices within cells within structures.
    mat_elements
        Elements of a MATLAB file, beside one for each of its bytes: half a million empty cells, which take 2 s and
        100 MiB to read.
    mat_header, mat_head
        Bytes of the header of a MATLAB file, and of a variable's head: more than tags, flags, 32 axes and a name take.
    yaml_bytes, yaml_nodes
        Of a YAML file: PyYAML reads a megabyte in 10 s.
    hash_threads
        Threads that hash a store, without Python's lock.
    hashed_part
        Bytes of a file that are hashed together: they fit into a processor's second cache.
    thread_bytes
        Addresses that a thread takes: a stack of 8 MiB, and the 64 MiB that glibc reserves for what it allocates.
    image_side
        Pixels of a resampled image's side.
    counts
        Sum of a sparse matrix up to which its elements are counts of 32 bits.
    shown_values, shown_text
        Values of an array or sequence, and characters of other values, that a `repr` writes out.
    suggestions, similarity
        Names that a message suggests for a misspelt one, at most; ratio of matching characters (Python's difflib) from
        which a name is similar to it.
    map_pixels
        Of a map's longer side in a notebook, more than the picture has.
    patience_s, often_s, seldom_s
        Before a progress line is drawn (it would vanish at once); between lines on a terminal, and in a log.
    long_s
        Seconds; a longer run is announced before it starts, or as soon as its time is known.
    """

    packed: int = 512
    least_in_parts: int = 512 * 2**20
    least_whole: int = 64 * 2**20
    small_file: int = 10**6
    most_of_small: int = 128 * 2**20
    listed_chunks: int = 10_000
    chunk_entry: int = 4
    slab_bytes: int = 16 * 2**20
    chunk_cache: int = 2**20
    nested: int = 100
    mat_elements: int = 2_500_000
    mat_header: int = 128
    mat_head: int = 2**10
    yaml_bytes: int = 2**20
    yaml_nodes: int = 2**17
    hashed_part: int = 256 * 2**10
    hash_threads: int = 4
    thread_bytes: int = 72 * 2**20
    image_side: int = 1 << 13
    counts: int = 2**32
    shown_values: int = 4
    shown_text: int = 240
    suggestions: int = 3
    similarity: float = 0.7
    map_pixels: int = 160
    patience_s: float = 0.5
    often_s: float = 0.2
    seldom_s: float = 30.0
    long_s: float = 10.0


TOL = Tolerances()
