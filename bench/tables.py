"""The results of a run as rows of tables, losses included."""

from mmmgpu.bench.timing import COPY, REFERENCE

WORKS = f"{'':32}  median ms          quartiles   cpu ms  x ref  x peer    bytes    flops"
WORKS += "    first    moved  differs"
OURS = ("warp", "opencl", "ours", "adjoint")


def work_tables(results):
    """For each work its name, and a line for each contender under the heading `WORKS`.

    cpu: of all threads, the least of all runs; threads that spin count.
    x ref, x peer: how many times faster than the reference, and than the best other library.
    bytes, flops: shares of the copy bandwidth and of the arithmetic peak.
    first, moved: [ms] the first run, in which kernels are fetched from the cache or compiled; and
        to bring arrays to the device and results back, of wholes with all that is prepared once.
    differs: from the reference, as a share of its scale.
    """
    for work in results["works"].values():
        rows = work["contenders"]
        slow = rows[REFERENCE]["median_ms"]
        peers = [r["median_ms"] for who, r in rows.items() if is_peer(who)]
        best = min(peers, default=None)
        yield work["name"], [line(who, row, slow, best, work) for who, row in rows.items()]


def line(who, row, slow, best, work):
    """A contender in one line."""
    ms = row["median_ms"]
    low, high = row["quartiles_ms"]
    beside = f"{best / ms:.2f}" if best and who.partition(":")[0] in OURS else ""
    said = f"  {who:30}{ms:11.4g}{low:9.4g} .. {high:<6.4g}"
    said += f"{row['cpu_ms']:9.4g}{slow / ms:7.3g}{beside:>8}"
    said += f"{percent(row.get('bandwidth')):>9}{percent(row.get('arithmetic')):>9}"
    if "first_ms" in row:
        said += f"{row['first_ms']:9.3g}{row['transfer_ms']:9.3g}{row['difference']:9.0e}"
    rate = "" if work["unit"] == "run" else f"  {1e3 * work['items'] / ms:.3g} {work['unit']}s/s"
    return said + rate


def is_peer(who):
    """Whether a contender is another library."""
    return not who.startswith((REFERENCE, COPY)) and who.partition(":")[0] not in OURS


def percent(share):
    """A share, or nothing."""
    return "" if share is None else f"{100 * share:.3g} %"


def other_tables(results):
    """(title, header, rows) of what else there is in the results."""
    if growth := results.get("growth"):
        rows = [
            (
                axis,
                name,
                f["exponent"],
                ", ".join(map(str, f["counts"])),
                ", ".join(map(str, f["median_ms"])),
            )
            for axis, backends in growth.items()
            for name, f in backends.items()
        ]
        yield "Growth", ("with", "by", "exponent", "counts", "median [ms]"), rows
    if threads := results.get("threads"):
        rows = [(work, times[-1]) for work, times in threads["gain"].items()]
        yield f"Gain of {threads['counts'][-1]} threads over one", ("work", "times"), rows
    if startup := results.get("startup"):
        rows = [(name, s["empty_cache_s"], s["full_cache_s"]) for name, s in startup.items()]
        yield "First frame of a new process [s]", ("by", "empty cache", "full cache"), rows
        times = [s["compiled_s"] for s in startup.values()]
        rows = [(operation, *(t[operation] for t in times)) for operation in times[0]]
        yield "Compiled for an empty cache [s]", ("kernels of", *startup), rows
    if pipeline := results.get("pipeline"):
        for name, step in pipeline["steps"].items():
            rows = [(where, percent(share)) for where, share in step["profile"].items()]
            yield f"{name}: {step['seconds']} s", ("samples in", "share"), rows
    for name, found in results.get("endurance", {}).items():
        memory, files = found["resident_mb"], found["open_files"]
        rows = [("resident [MB]", memory[0], memory[-1]), ("open files", files[0], files[-1])]
        yield f"{found['frames']} frames on {name}", ("", "first", "last"), rows
    if targets := results.get("targets"):
        said = {True: "yes", False: "NO", None: "not judged"}
        rows = [(n, t["bound"] or "", t["value"], said[t["met"]]) for n, t in targets.items()]
        yield "What must hold", ("target", "bound", "measured", "met"), rows


def compared_rows(found):
    """A row for each contender of ours of `bench.comparison.compare_runs`."""
    for row in found["rows"]:
        yield tuple(row[key] for key in ("work", "by", "old_ms", "new_ms", "times", "verdict"))


def compared_others(found):
    """The same of all but works."""
    for row in found["others"]:
        yield tuple(row[key] for key in ("what", "by", "old", "new", "times", "verdict"))
