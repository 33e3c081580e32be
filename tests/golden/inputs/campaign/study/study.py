def tasks(options):
    for n in (4, 16):
        for k in range(options["replicates"]):
            yield {"n": n, "label": "few" if n < 9 else "many", "replicate": k}


def run(task, rng):
    x = rng.normal(size=task["n"])
    return {"mean": float(x.mean()), "inside": bool(abs(x.mean()) < 1), "above": int((x > 0).sum())}


def summary(results):
    return f"mean {results['mean'].mean():.3f}\n"
