import torch

from agents.optimizer import PopulationAdam


def test_each_agent_descends_as_torch_adam_with_its_own_step_size():
    step_sizes = torch.tensor([1e-1, 1e-3, 1e-5])
    generator = torch.Generator().manual_seed(0)
    parameters = torch.randn(3, 50, generator=generator)
    twins = [parameters[p].clone().requires_grad_() for p in range(3)]
    optimizers = [torch.optim.Adam([twin], lr=lr) for twin, lr in zip(twins, step_sizes.tolist(), strict=True)]
    population = PopulationAdam(parameters, step_sizes)
    for step in range(50):
        gradient = torch.randn(3, 50, generator=generator) * 10.0 ** (step % 5 - 4)
        population.step_(gradient)
        for p, optimizer in enumerate(optimizers):
            twins[p].grad = gradient[p].clone()
            optimizer.step()
    for p, twin in enumerate(twins):
        torch.testing.assert_close(parameters[p], twin.detach(), rtol=1e-6, atol=1e-7)
