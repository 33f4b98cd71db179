"""From a description to arrays: storages, dofs, elements, conditions."""
