//! Light whose answer is known without a reference (design: section 6), through the stages that a bake runs.

mod caps;
mod closed_forms;
mod colour;
mod companions;
mod context;
mod crossings;
mod gaps;
mod invariance;
mod luminaires;
mod photons;
mod samplers;
mod support;
