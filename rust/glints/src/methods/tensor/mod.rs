//! Tensor-decomposed distributions of normals.

pub mod cp;
