"""The measurement plan: which poses make the parameters, or what they predict, most certain.

A plan is judged by a criterion Φ of its information matrix M = M₀ + Σ_i B_iᵀ Σ_i⁻¹ B_i
(`criterion` says what that is, `criteria` lists those that there are).  The relaxation gives the
best weights over all candidates and with them a bound that no plan falls below; exchange makes a
plan of whole poses, and polish moves these off the candidates.
"""
