# %% [markdown]
# # Results in a notebook
#
# This notebook reads a run folder, as `morph track` writes it, and plots what it holds. Name yours in place of `run`.

# %%
from pathlib import Path

import h5py
import matplotlib.pyplot as plt
import numpy as np

import morph_dslam as md

run = Path("run")

# %% [markdown]
# ## What was tracked
#
# `frames.csv` is the easiest to read, `result.h5` has everything in SI units. Values are NaN where a frame was not
# tracked, so masks are rarely needed.

# %%
with h5py.File(run / "result.h5") as file:
    time = file["timestamp"][:]
    status = file["status"].asstr()[:]
    values, deviations = file["parameters"][:], file["parameter_std"][:]
    stress, stress_std = file["largest_von_mises"][:], file["largest_von_mises_std"][:]
print(f"{(status == 'tracked').sum()} of {len(status)} frames tracked")

# %% [markdown]
# ## Parameters with their standard deviations
#
# The model in the run folder names the parameters and their units. A band of two standard deviations should contain the
# true value in about 95 % of the frames.

# %%
model = md.load_model(run / "model.morph")
figure, axes = plt.subplots(len(model.parameters), sharex=True, squeeze=False)
for k, parameter in enumerate(model.parameters):
    center = parameter.display(values[:, k])
    band = parameter.display(values[:, k] + 2 * deviations[:, k]) - center
    axes[k, 0].plot(time, center)
    axes[k, 0].fill_between(time, center - band, center + band, alpha=0.3)
    axes[k, 0].set_ylabel(f"{parameter.name} [{parameter.unit}]")
axes[-1, 0].set_xlabel("time [s]")
figure.savefig("parameters.png")

# %% [markdown]
# ## The largest stress over time

# %%
figure, axis = plt.subplots()
axis.errorbar(time, stress / 1e6, 2 * stress_std / 1e6, fmt=".", capsize=2)
axis.set(xlabel="time [s]", ylabel="largest von Mises stress [MPa]")
figure.savefig("stress.png")

# %% [markdown]
# ## A field in one frame
#
# The model turns parameters into fields: displacement, strain and stress at all nodes.

# %%
worst = int(np.nanargmax(stress))
mu = values[worst]
positions = model.positions(mu)  # (n, 3) m, in the object frame
field = np.max([model.von_mises(mu, place) for place in model.stresses], axis=0)  # (n,) Pa
figure = plt.figure()
axis = figure.add_subplot(projection="3d")
shown = axis.scatter(*(1e3 * positions.T), c=field / 1e6, s=4)
figure.colorbar(shown, label="von Mises stress [MPa]")
axis.set(xlabel="x [mm]", ylabel="y [mm]", zlabel="z [mm]", title=f"frame {worst}")
figure.savefig("field.png")

# %% [markdown]
# ## The path of one material point
#
# Poses are in `camera_from_object`; a point of the object is moved by the displacement first, then by the pose.

# %%
with h5py.File(run / "result.h5") as file:
    poses = file["camera_from_object"][:]
node = int(np.argmax(model.nodes[:, 0]))  # the node at the end of x
path = np.array(
    [pose[:3, :3] @ model.positions(mu)[node] + pose[:3, 3] for pose, mu in zip(poses, values, strict=True)]
)
print(f"it moved by {1e3 * np.linalg.norm(path[-1] - path[0]):.1f} mm")

# %% [markdown]
# ## Without a run folder
#
# The same quantities come directly from the tracker, frame by frame: `result.parameters`, `result.von_mises()`,
# `result.displacement_std()` and so on. [The first tutorial](sheet.md#the-same-from-python) shows the loop.
